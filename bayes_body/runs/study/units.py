"""The units of a study. A unit of a session's run tracks and smooths it; a closing unit makes of all runs of a session what the study asks for."""

import hashlib
import json
import tomllib
from collections import Counter
from collections.abc import Iterator
from glob import glob, has_magic
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from bayes_body.base.errors import input_error
from bayes_body.recording.session.people_folders import SESSION_FILE, recording_folder
from bayes_body.results.storage.names import SUMMARY_FILE
from bayes_body.runs.study.study_file import StudyFile, TrackTable

if TYPE_CHECKING:
    from bayes_body.runs.study.unit_process import Job

# The unit of a session that follows its runs, and the folder of all runs together.
CLOSING, ALL_RUNS, SMOOTHED = "closing", "all_runs", "_smoothed"
# Options of `track` that take a value, by their names in a study's file.
VALUES = ("model", "kernel", "particles", "layers", "move", "moves", "leapfrog_steps", "first_frame", "frames", "init")


class Unit(NamedTuple):
    """A piece of work for one process.

    Attributes:
        session: the session's name.
        variant: the name of the way to track it; empty if there is only one.
        name: the name within the session, such as `run_1`.
        commands: command lines of bayes-body, one after the other.
        folder: the run that it tracks, or that it writes at the end.
        shape: equal for units that use the same compiled programs.
        digest: of the options of `track` and the session's file: a run with another digest has other draws. Empty for a unit that does not track.
        work: digest of all commands: a unit with another one is not done.
        frames: number of frames to track; None if it is not known.
        needs: keys of the units that must be done before.
        results: names of the files in its folder that exist once it is done.
    """

    session: str
    variant: str
    name: str
    commands: tuple[tuple[str, ...], ...]
    folder: Path
    shape: str
    digest: str
    work: str
    frames: int | None = None
    needs: tuple[str, ...] = ()
    results: tuple[str, ...] = (SUMMARY_FILE,)

    @property
    def key(self) -> str:
        """The unit's name in the study."""
        return f"{self.session}/{self.name}"

    @property
    def is_closing(self) -> bool:
        """Whether it follows the runs of a session."""
        return bool(self.needs)


class Recording(NamedTuple):
    """What a study needs to know of a session.

    Attributes:
        name: of its folder.
        folder: of the session.
        shape: the cameras' sizes and what each has, as text.
        digest: of the session's file; empty if it cannot be read.
        frames: their number; None if it is not known.
    """

    name: str
    folder: Path
    shape: str
    digest: str
    frames: int | None


def session_folders(patterns: list[str], note: list[str] | None = None) -> list[Path]:
    """Return the folders of sessions that patterns name.

    Args:
        patterns: absolute paths, with or without wildcards. A folder that a wildcard matches and that is no session is left out.
        note: receives a sentence for each folder that is left out.

    Raises:
        InputError: a pattern matches no session, or two sessions have one name.
    """
    folders: list[Path] = []
    for pattern in patterns:
        # The name of a folder may have the characters of a pattern.
        if not has_magic(pattern) or (Path(pattern) / SESSION_FILE).is_file():
            folders.append(Path(pattern))
            continue
        # Path.glob does not take absolute patterns.
        matches = sorted(Path(match) for match in glob(pattern, recursive=True))  # noqa: PTH207
        sessions = [match for match in matches if (match / SESSION_FILE).is_file()]
        if not sessions:
            problem = f"matches {len(matches)} files and folders, none with a {SESSION_FILE}" if matches else "matches nothing"
            raise input_error(f"sessions: {pattern}", problem, "folders made by `bayes-body import`", "correct the pattern")
        if note is not None:
            note.extend(f"{match}: no {SESSION_FILE} in it, left out." for match in matches if match.is_dir() and match not in sessions)
        folders.extend(sessions)
    folders = list(dict.fromkeys(folder.resolve() for folder in folders))
    check_names(folders)
    return folders


def check_names(folders: list[Path]) -> None:
    """Refuse two sessions of one name, whose runs would share a folder, and names that the study's own files have.

    Raises:
        InputError: there are some.
    """
    for name, count in Counter(map(session_name, folders)).items():
        if count > 1:
            same = " and ".join(str(folder) for folder in folders if session_name(folder) == name)
            raise input_error(
                "sessions", f"{same} have one name", "one name for each session, since it names a folder of the study", "rename one of them"
            )
        if name.startswith(".") or not name:
            raise input_error("sessions", f"'{name}' begins with a dot", "a name that is not hidden", "rename the folder")


def session_name(folder: Path) -> str:
    """Return the name of a session in a study: that of its folder; of a person of a recording, `RECORDING_person_2`."""
    recording = recording_folder(folder)
    return folder.name if recording is None else f"{recording.name}_{folder.name}"


def recording_of(folder: Path) -> Recording:
    """Return what a study needs to know of a session. A faulty file is no error here: `bayes-body track` says what is wrong with it."""
    try:
        content = (folder / SESSION_FILE).read_bytes()
        tables = tomllib.loads(content.decode("utf-8-sig"))
        cameras = tables.get("camera", [])
        shape = repr([(camera.get("size_px"), sorted(camera)) for camera in cameras])
        frames = tables.get("frames")
    except (OSError, ValueError, AttributeError, TypeError):
        return Recording(session_name(folder), folder, "", "", None)
    return Recording(session_name(folder), folder, shape, hashlib.sha256(content).hexdigest(), frames if isinstance(frames, int) else None)


def units_of(study: StudyFile, out: Path) -> list[Unit]:
    """Return all units of a study, session by session; the closing unit of a session's variant follows its runs.

    Args:
        study: the study; its sessions are folders, no patterns.
        out: the folder of the study.
    """
    variants: list[tuple[str, TrackTable]] = [(variant.name, variant) for variant in study.variant] or [("", study)]
    recordings = [recording_of(Path(folder)) for folder in study.sessions]
    return [unit for recording in recordings for name, table in variants for unit in _units_of_variant(study, out, recording, name, table)]


def _units_of_variant(study: StudyFile, out: Path, recording: Recording, variant: str, table: TrackTable) -> Iterator[Unit]:
    prefix = f"{variant}_" if variant else ""
    options, plugins = _options(study, table), plugins_of(study, table)
    no_pictures = () if draws_pictures(study, table) else ("--no-pictures",)
    # The pictures of several runs are those of all runs together.
    of_a_run = ("--no-pictures",) if study.runs > 1 else no_pictures
    frames, shape = table.frames or study.frames or recording.frames, f"{variant} {recording.shape}"
    runs = []
    for number in range(1, study.runs + 1):
        folder, seed = out / recording.name / f"{prefix}run_{number}", str(study.seed + number - 1)
        track = ("track", str(recording.folder), "--out", str(folder), "--runs", "1", "--seed", seed, *options, *plugins)
        commands: list[tuple[str, ...]] = [(*track, *of_a_run)]
        if "smooth" in study.steps:
            commands.append(("smooth", str(folder), "--out", f"{folder}{SMOOTHED}", "--seed", seed, *of_a_run, *plugins))
        digest = digest_of(out, recording.digest, [track])
        work = digest_of(out, digest, commands)
        runs.append(Unit(recording.name, variant, folder.name, tuple(commands), folder, digest_of(out, shape), digest, work, frames))
    yield from runs
    combined, smoothed = out / recording.name / f"{prefix}{ALL_RUNS}", "smooth" in study.steps
    commands = list(_closing_commands(study, [run.folder for run in runs], combined, no_pictures, plugins))
    if not commands:
        return
    yield Unit(
        session=recording.name,
        variant=variant,
        name=f"{prefix}{CLOSING}",
        commands=tuple(commands),
        folder=final_folder([run.folder for run in runs], combined, smoothed),
        shape=digest_of(out, f"{CLOSING} {shape}"),
        digest="",
        work=digest_of(out, *(run.work for run in runs), commands),
        needs=tuple(run.key for run in runs),
    )


def digest_of(out: Path, *parts: object) -> str:
    """Return a digest that stays when the folder of the study is moved."""
    return hashlib.sha256(repr(parts).replace(str(out), "").encode()).hexdigest()[:20]


def _closing_commands(
    study: StudyFile, runs: list[Path], combined: Path, no_pictures: tuple[str, ...], plugins: tuple[str, ...]
) -> Iterator[tuple[str, ...]]:
    smoothed = "smooth" in study.steps
    endings = ("", SMOOTHED) if smoothed else ("",)
    if len(runs) > 1:
        for ending in endings:
            yield ("combine", *(f"{run}{ending}" for run in runs), "--out", f"{combined}{ending}", *no_pictures, *plugins)
    folder = final_folder(runs, combined, smoothed)
    for verb in ("report", "view"):
        if verb in study.steps:
            yield (verb, str(folder), *plugins)
    if "gait" in study.steps:
        yield ("gait", str(folder), "--overwrite", *plugins)
    if study.export:
        yield ("export", str(folder), "--to", ",".join(study.export), "--overwrite", *plugins)


def final_folder(runs: list[Path], combined: Path, smoothed: bool) -> Path:
    """Return the run of a session that its row in the study shows."""
    folder = combined if len(runs) > 1 else runs[0]
    return Path(f"{folder}{SMOOTHED}") if smoothed else folder


def _options(study: StudyFile, table: TrackTable) -> tuple[str, ...]:
    """Return the options of `track`: those of the variant, else those of the study."""
    options: list[str] = []
    for name in VALUES:
        value = getattr(table, name)
        value = getattr(study, name) if value is None else value
        if value is not None:
            options += [f"--{name.replace('_', '-')}", str(value)]
    for name, value in (study.set | table.set).items():
        options += ["--set", f"{name}={json.dumps(value)}"]
    recover = study.recover if table.recover is None else table.recover
    if recover is not None:
        options.append("--recover" if recover else "--no-recover")
    draws = table.keep_draws or study.keep_draws
    return (*options, *(("--keep", f"draws={draws}") if draws else ()))


def draws_pictures(study: StudyFile, table: TrackTable) -> bool:
    """Return whether videos and stills are drawn."""
    return table.pictures if table.pictures is not None else study.pictures is not False


def plugins_of(study: StudyFile, table: TrackTable) -> tuple[str, ...]:
    """Return the options of a command that name the plugins of the study and of a variant."""
    return tuple(text for plugin in dict.fromkeys([*study.plugins, *table.plugins]) for text in ("--plugin", plugin))


def stored_frames(folder: Path) -> int:
    """Return how many frames of a run are on the disk, by the names of their files; all of them once the run has its summary."""
    try:
        names = [path.stem for path in (folder / "frames").iterdir() if path.suffix == ".npz"]
    except OSError:
        return 0
    return max((int(name) + 1 for name in names if name.isdecimal()), default=0)


def is_finished(work: "Unit | Job") -> bool:
    """Whether the results of a unit are on the disk."""
    return all((Path(work.folder) / name).is_file() for name in work.results)
