"""`bayes-body track`: track the person in a session."""

from argparse import ArgumentTypeError
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from bayes_body.base.errors import InputError, input_error
from bayes_body.cli.arguments import setting
from bayes_body.cli.plugin_option import Plugins, own_terms
from bayes_body.cli.study import CLUSTER_HELP, track_several
from bayes_body.cli.terminal import say
from bayes_body.runs.limits import FEWEST_KEPT, LARGEST_SEED
from bayes_body.runs.people import ALL, people_sessions, person_of

if TYPE_CHECKING:
    from bayes_body.model.definition import Definition
    from bayes_body.recording.session.session import Session
    from bayes_body.runs.settings import LiveSettings, Settings

# Seconds without a new file after which a live recording has ended: by default, and at most a day.
WAIT_S, LONGEST_WAIT_S = 10.0, 86_400.0
LARGEST_PORT = 65_535


def track(
    session: list[Path] = typer.Argument(help="Folder of a session made by `bayes-body import`; several make a study, as sessions/*/ does."),
    out: Path | None = typer.Option(
        None,
        "--out",
        help="Folder for the run; by default SESSION_run, or the next free SESSION_run_2 ... Without --resume it must not hold a run. "
        "With several sessions: folder of the study, which has OUT/SESSION/RUN/; the same command again continues it.",
    ),
    model: str | None = typer.Option(
        None,
        "--model",
        help="A definition's name (`bayes-body models`) or the path of your own; by default keypoints if there are keypoints, walker_from_the_side "
        "(legs only) if there is one still camera without, else silhouettes.",
    ),
    kernel: str | None = typer.Option(
        None,
        "--kernel",
        help="laplace (keypoints), tempered, hmc, sir, particle_bp (parts), or annealed (a mode seeker: the pose without its uncertainty); by "
        "default the model's own.",
    ),
    particles: int | None = typer.Option(None, "--particles", help="Particles per run."),
    layers: int | None = typer.Option(None, "--layers", help="Annealing layers per frame (annealed only)."),
    move: str | None = typer.Option(None, "--move", help="hmc or random_walk (tempered only)."),
    moves: int | None = typer.Option(None, "--moves", help="Markov moves of a particle per stage (tempered only)."),
    leapfrog_steps: int | None = typer.Option(None, "--leapfrog-steps", help="Leapfrog steps per trajectory (tempered and hmc only)."),
    settings: list[str] = typer.Option([], "--set", metavar="NAME=VALUE", help="Another option of the kernel, such as step=0.1; may be repeated."),
    person: str | None = typer.Option(
        None,
        "--person",
        help="Of a recording with several people: the number of one (`bayes-body people` lists them), or `all`, which makes a study with a folder "
        "for everyone; by default the one in view of most cameras for the longest time.",
    ),
    runs: int | None = typer.Option(
        None,
        "--runs",
        help="Number of independent filters, 1 by default; R-hat needs two or more. With several sessions, each has a process and a folder.",
    ),
    first_frame: int | None = typer.Option(
        None,
        "--first-frame",
        help="Number of the first frame to track, as in the file names; in a video they count from 0. The session's by default.",
    ),
    frames: int | None = typer.Option(None, "--frames", help="Number of frames from the first on; all by default."),
    seed: int | None = typer.Option(None, "--seed", help="Seed of everything random, 0 by default."),
    init: str | None = typer.Option(
        None,
        "--init",
        help="First pose: `given` by the session, or looked for in the pictures where it gives none (the default); or `auto`, always looked for.",
    ),
    recover: bool | None = typer.Option(
        None, "--recover/--no-recover", help="Start anew where the person is found again after a loss; by default only with the kernel particle_bp."
    ),
    resume: bool = typer.Option(
        False, "--resume", help="Continue the run in --out after its last complete frame; options that are not given are those of that run."
    ),
    keep: str | None = typer.Option(
        None, "--keep", metavar="draws=N", help="Store N draws of a frame and run instead of all particles; diagnostics are computed from all."
    ),
    no_pictures: bool = typer.Option(False, "--no-pictures", help="Leave out overlay.mp4 and the stills; --resume without this option draws them."),
    live: Path | None = typer.Option(
        None,
        "--live",
        metavar="FOLDER",
        help="Track frames as they come: folder to which a pose estimator writes CAMERA_json, a file a frame. For models that read keypoints only.",
    ),
    wait: float | None = typer.Option(
        None,
        "--wait",
        metavar="SECONDS",
        help=f"Seconds without a new file that end the recording (--live only); {WAIT_S:g} by default.",
    ),
    port: int | None = typer.Option(
        None, "--port", help="Port of the page that shows the last second, on this machine (--live only); a free one by default."
    ),
    cluster: str | None = typer.Option(None, "--cluster", help=CLUSTER_HELP),
    plugin: Plugins = None,
) -> None:
    """Track the person in a session; writes run.toml, frames, posterior.nc, summary.json, overlay.mp4 and stills."""
    whom = None if person is None else person_of(person)
    if len(session) > 1 or cluster is not None or whom == ALL:
        for option, value in (("--live", live), ("--wait", wait), ("--port", port)):
            if value is not None:
                problem = f"given with {f'{len(session)} sessions' if len(session) > 1 else 'a study'}"
                raise input_error(option, problem, "one session, and one person", "track the live recording by itself")
        table: dict[str, Any] = {
            "model": model, "kernel": kernel, "particles": particles, "layers": layers, "move": move, "moves": moves,
            "leapfrog_steps": leapfrog_steps, "set": _with_settings({}, settings), "first_frame": first_frame,
            "frames": frames, "init": init, "recover": recover, "runs": runs, "seed": seed, "person": whom,
            "keep_draws": draws_of(keep), "pictures": False if no_pictures else None, "plugins": [str(file) for file in plugin or ()],
        }  # fmt: skip
        if out is None and len(session) == 1:
            out = folder_beside(session[0], "people")
        track_several(session, out, {name: value for name, value in table.items() if value is not None}, cluster)
        return
    (session_folder,) = session
    if whom is not None and live is not None:
        raise input_error("--person", f"{whom} with --live", "one of the two", "the person in view of most cameras is followed live")
    if whom is not None:
        (session_folder,) = people_sessions(session_folder, whom, say, bar=True)
    from bayes_body.base.config import configure

    configure()
    from bayes_body.runs.settings import AUTO, GIVEN, Settings

    live_settings = live_of(live, wait, port)
    # Frames of a live recording may still come.
    recording = _recording(session_folder, None if live_settings else first_frame)
    counts = {"particles": particles, "layers": layers, "moves": moves, "leapfrog_steps": leapfrog_steps}
    for name, value in (counts | {"runs": runs}).items():
        check_range(f"--{name.replace('_', '-')}", value, 1)
    check_range("--frames", frames, 1, None if live_settings else recording.frames)
    check_range("--seed", seed, 0, LARGEST_SEED)
    if init not in (None, GIVEN, AUTO):
        raise input_error("--init", f"'{init}'", f"{GIVEN} or {AUTO}", "give one of them")
    overrides = {name: value for name, value in (counts | {"move": move}).items() if value is not None}
    overrides = _with_settings(overrides, settings)
    folder = out or _free_run(session[0], resume, f"person_{whom}" if whom else "run")
    if out is None:
        say(f"run        {folder}")
    draws, pictures = draws_of(keep), not no_pictures
    asked = Settings(
        session_folder, folder, model, kernel, overrides, runs, first_frame, frames, seed, init, recover, resume, draws, pictures, live_settings
    )
    if whom is None and live is None and not resume:
        from bayes_body.recording.readers.people.presence import describe_default

        for sentence in describe_default(recording):
            say(f"note: {sentence}")
    _run(asked, recording, plugin)


def _run(asked: "Settings", recording: "Session", plugins: list[Path] | None) -> None:
    """Check the files of a recording, and track it."""
    from bayes_body.cli.models import checked_definition
    from bayes_body.model.definition import load_definition
    from bayes_body.results.storage.names import RUN_FILE
    from bayes_body.results.storage.run_file import read_run_file
    from bayes_body.runs.live import run_live
    from bayes_body.runs.run import run

    with own_terms(plugins):
        definition = None
        if asked.resume and (asked.out / RUN_FILE).exists():
            # This is checked before the model is read: without the run's plugins, some of its terms do not exist.
            definition = load_definition(read_run_file(asked.out)["run"]["model"])
        if asked.model is not None:
            definition = checked_definition(asked.model)
        if asked.live is None:
            _check_files(recording, asked.frames, definition)
        (run_live if asked.live else run)(asked, show=lambda line: say(line), bar=True)
    pictures = "overlay.mp4, overlay/, " if asked.pictures and not asked.live else ""
    say(f"{asked.out}: posterior.nc, summary.json, {pictures}frames/, run.toml")


def draws_of(keep: str | None) -> int | None:
    """Return the number in `draws=200`; None without the option.

    Raises:
        InputError: the text has another form.
    """
    if keep is None:
        return None
    name, _, number = keep.partition("=")
    if name != "draws" or not (number.isascii() and number.isdecimal()) or int(number) < FEWEST_KEPT:
        raise input_error("--keep", keep, f"draws=N with N from {FEWEST_KEPT} up", "give --keep draws=200, for example")
    return int(number)


def live_of(folder: Path | None, wait_s: float | None, port: int | None) -> "LiveSettings | None":
    """Return the settings of --live; None without it.

    Raises:
        InputError: --wait or --port without it, or outside its range; or no such folder.
    """
    from bayes_body.runs.settings import LiveSettings

    for option, value in (("--wait", wait_s), ("--port", port)):
        if folder is None and value is not None:
            raise input_error(option, f"{value:g} without --live", "--live FOLDER", "add it, or leave the option out")
    if folder is None:
        return None
    if not folder.is_dir():
        expected = "the folder to which the pose estimator writes a folder CAMERA_json for each camera"
        raise input_error(f"--live {folder}", "not a folder" if folder.exists() else "no such folder", expected, "check the path")
    if wait_s is not None and not 0 < wait_s <= LONGEST_WAIT_S:
        raise input_error("--wait", f"{wait_s:g}", f"seconds, above 0, up to {LONGEST_WAIT_S:g}", "give another number")
    check_range("--port", port, 0, LARGEST_PORT)
    return LiveSettings(folder, WAIT_S if wait_s is None else wait_s, port or 0)


def _free_run(session: Path, resume: bool, ending: str) -> Path:
    """Return `SESSION_ENDING` beside the session, or the next free `SESSION_ENDING_2`, ..."""
    if resume:
        raise input_error("--resume", "no --out", "the folder of the run to continue", "name it with --out")
    return free_beside(session, ending)


def free_beside(session: Path, ending: str) -> Path:
    """Return `SESSION_ENDING` beside a session, or the next free `SESSION_ENDING_2`, ..."""
    from bayes_body.results.storage.names import free_folder

    return free_folder(folder_beside(session, ending))


def folder_beside(session: Path, ending: str) -> Path:
    """Return `SESSION_ENDING` beside a session."""
    folder = session if session.is_dir() else session.parent
    # The name of `.` is empty.
    folder = folder if folder.name not in ("", "..") else folder.resolve()
    return folder.with_name(f"{folder.name}_{ending}")


def _with_settings(overrides: dict[str, Any], texts: list[str]) -> dict[str, Any]:
    """Return the options of the kernel with those that --set gives.

    Raises:
        InputError: a text has another form, or an option is given twice.
    """
    options = dict(overrides)
    for text in texts:
        try:
            name, value = setting(text)
        except ArgumentTypeError as error:
            raise InputError(f"--set: {error}") from None
        if name in options:
            raise input_error(f"--set {text}", f"{name} is given already, {options[name]}", "one value for each option", "leave one of them out")
        options[name] = value
    return options


def _recording(folder: Path, first_frame: int | None) -> "Session":
    """Return the session from the first frame to track on."""
    from bayes_body.recording.readers.excerpt import excerpt

    return excerpt(session_in(folder), first_frame)


def session_in(folder: Path) -> "Session":
    """Return the session of a folder.

    Raises:
        InputError: there is none, or it has faults.
    """
    from bayes_body.recording.session.read import FILE_NAME, load_session

    if not folder.exists() or (folder.is_dir() and not (folder / FILE_NAME).exists()):
        problem = f"no {FILE_NAME} in it" if folder.exists() else "no such folder"
        raise input_error(folder, problem, "the folder of a session", "check the path, or make a session with `bayes-body import`")
    return load_session(folder)


def _check_files(session: "Session", frames: int | None, definition: "Definition | None") -> None:
    """Check that the files of a session exist, so that the run does not fail half way. Without a definition, the data choose the model.

    Videos are decoded once, to find damage, unless the model reads only keypoints.
    """
    from bayes_body.base.progress import waiting
    from bayes_body.model.definition import evidence_of
    from bayes_body.recording.readers.check import check_session

    by_keypoints = any(view.keypoints for view in session.views) if definition is None else evidence_of(definition) == ["keypoints"]
    with waiting("looking at the recording's files"):
        remarks = check_session(session, frames, decode=not by_keypoints)
    for remark in remarks:
        say(f"note: {remark}")


def check_range(option: str, value: int | None, least: int, most: int | None = None) -> None:
    """Refuse a value outside its range; None means that the option was not given.

    Raises:
        InputError: the value is outside.
    """
    if value is not None and (value < least or (most is not None and value > most)):
        raise input_error(option, str(value), f"a whole number from {least}{f' to {most}' if most is not None else ' up'}", "give another number")
