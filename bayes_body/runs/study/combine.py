"""Put the independent runs of one session together as the chains of one run folder, which everything reads like any other run.

A run of a filter with more than 200 particles is stored with 200 draws of each frame, so that the disk does not hold a study twice. They are chosen
like those of `bayes-body track --keep`, and R-hat, effective sample sizes and all other figures of diagnostics are computed of all particles before.
Runs that are thinned already, and paths of a smoother, are stored as they are.

The frames are read from the runs one at a time, and written into `posterior.nc` as they come. There are no files of single frames: a call that was
stopped begins again, and its result is the same to the last bit. It is made anew if a run has changed since.
"""

import json
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bayes_body.base.errors import InputError, input_error
from bayes_body.base.files.atomic import remove_partial
from bayes_body.base.files.lock import locked
from bayes_body.base.progress import watched
from bayes_body.density.factor import Transition
from bayes_body.initial import Show
from bayes_body.results.posterior import stream_posterior
from bayes_body.results.posterior.chains import joined
from bayes_body.results.posterior.diagnosis import declared_sample
from bayes_body.results.posterior.thinning import thinned
from bayes_body.results.storage import FrameFiles
from bayes_body.results.storage.entries import Entries, Entry
from bayes_body.results.storage.frame_archive import FrameArchive, Place, arrays_of, digest_of, in_posterior
from bayes_body.results.storage.manifest import read_manifest
from bayes_body.results.storage.names import FRAMES_FOLDER, INDEX_FILE, MANIFEST_FILE, OVERLAY_FILE, POSTERIOR_FILE, RUN_FILE, SUMMARY_FILE
from bayes_body.results.storage.results import Results
from bayes_body.results.storage.run_changes import refuse_strangers, run_id
from bayes_body.results.storage.run_file import read_run_file, write_run_file
from bayes_body.results.storage.saved_run import SavedRun, load_run
from bayes_body.runs.finish import finish
from bayes_body.runs.settings import Record, refuse_occupied
from bayes_body.tracking.draws import Draws, FrameResult, Frames, Timing, timing_of
from bayes_body.tracking.smooth import LastFirst

# Draws of a frame and run that are stored. Of a few runs, they are some thousand.
DRAWS = 200
# Fitted sizes of a body that differ by less, in metres, are the same: processors round differently.
SAME_SIZE = 1e-4
RESULT_FILES = (MANIFEST_FILE, SUMMARY_FILE, POSTERIOR_FILE, f"{FRAMES_FOLDER}/{INDEX_FILE}", OVERLAY_FILE)


class Part(NamedTuple):
    """One of the runs: its folder, its tables, and the number and the last digest of the frames of which its posterior was made."""

    folder: Path
    record: Record
    frames: int
    last: str


def combine_runs(folders: Sequence[Path], out: Path, show: Show, bar: bool, keep: int | None = DRAWS, pictures: bool = True) -> dict[str, Any]:
    """Put finished runs together, one after the other as chains, and write everything that `track` writes. Return the content of `summary.json`.

    Nothing is computed if the folder has these runs already. A folder that has others, or these as they were before, is made anew.

    Args:
        folders: folders of two or more runs of one session, model and kernel, with different seeds: all of filters, or all smoothed.
        out: folder for the result.
        show: receives lines for the user.
        bar: whether to show the progress on standard error.
        keep: number of draws of a frame and run that are stored; None for all.
        pictures: whether to draw the video and the stills.

    Raises:
        InputError: a run is unfinished or damaged, the runs do not belong together, the recording has changed, the folder has something else or is
            used by another process, or a file cannot be written.
    """
    parts = [_part(folder) for folder in folders]
    _check(parts, out)
    if not all(_are_same_sizes(part, parts[0], "outline_radii_m") for part in parts):
        show(f"note: the runs fitted other thicknesses of the body; the figures of the fit and the pictures take those of {parts[0].folder}.")
    with locked(out):
        record = _record(parts, keep, show)
        run = _begin(out, record, show)
        summary = _finished(out, run, pictures)
        if summary is not None:
            show(f"{out}: these {len(parts)} runs are together already")
            return summary
        with ExitStack() as stack:
            runs = [stack.enter_context(load_run(part.folder)) for part in parts]
            if runs[0].changed_inputs:
                problem = f"{', '.join(sorted(runs[0].changed_inputs))}: changed or gone since the run was made"
                raise input_error(runs[0].folder, problem, "the recording of the run, for the figures and pictures", "put it back")
            if not _is_written(out, run):
                _write(out, run, record, runs, bar)
            return _finish(out, run, runs, show, bar, pictures)


def _part(folder: Path) -> Part:
    """Return what the folder of a run says of itself.

    Raises:
        InputError: there is no run, it is unfinished, or it is made of several.
    """
    if not (folder / POSTERIOR_FILE).exists():
        # Says what is wrong, and how to go on.
        load_run(folder).close()
    record, results = read_run_file(folder), read_manifest(folder).results
    if record.get("chains"):
        remedy = f"name these instead: {', '.join(record['chains']['folders'])}"
        raise input_error(folder, "several runs that were put together", "single runs", remedy)
    made_of = {(results[name].frames, results[name].last) for name in (POSTERIOR_FILE, SUMMARY_FILE) if name in results}
    number, last = made_of.pop() if len(made_of) == 1 and SUMMARY_FILE in results else (0, "")
    if number != len(FrameFiles(folder / FRAMES_FOLDER)):
        raise input_error(folder, "an unfinished run", "a finished one", "continue it with --resume")
    return Part(folder, record, number, last)


def _check(parts: Sequence[Part], out: Path) -> None:
    """Check that the runs are independent runs of the same, and that the result has a folder of its own.

    Raises:
        InputError: they are not, or it has not.
    """
    folders = [part.folder for part in parts]
    if len(parts) < 2:
        raise input_error("the runs", f"{len(parts)}", "two or more", "name more runs of the session, with different --seed")
    if out.resolve() in [folder.resolve() for folder in folders]:
        raise input_error("--out", str(out), "another folder than those of the runs", "name a new one")
    refuse_strangers(folders, [part.record for part in parts])
    first, seeds = parts[0], dict[int, Path]()
    for part in parts:
        seed = part.record["run"]["seed"]
        if seed in seeds:
            expected, remedy = "another seed in each run: equal seeds give equal draws", "leave one out, or track again with another --seed"
            raise input_error(part.folder, f"has the seed {seed}, as {seeds[seed]}", expected, remedy)
        seeds[seed] = part.folder
        if part.frames != first.frames:
            problem = f"{part.frames} frames, where {first.folder} has {first.frames}"
            raise input_error(part.folder, problem, "the same frames in all runs", "continue the shorter one with --resume, or leave it out")
        if not _are_same_sizes(part, first, "lengths_m"):
            problem = f"other fitted lengths of the body than {first.folder}"
            raise input_error(f"{part.folder / RUN_FILE}: first_pose", problem, "the same body in all runs", "leave it out")


def _are_same_sizes(part: Part, first: Part, name: str) -> bool:
    """Return whether two runs fitted the same sizes of the body with their first poses. These poses may differ: the search for them is random."""
    sizes, first_sizes = (run.record.get("first_pose", {}).get(name, {}) for run in (part, first))
    return sizes.keys() == first_sizes.keys() and all(np.allclose(sizes[key], first_sizes[key], 0, SAME_SIZE) for key in sizes)


def _record(parts: Sequence[Part], keep: int | None, show: Show) -> Record:
    """Return the tables of `run.toml`: those of the first run, and which runs are the chains."""
    first = {name: table for name, table in parts[0].record.items() if name != "check"}
    chains = {
        "folders": [str(part.folder.resolve()) for part in parts],
        "runs": [part.record["check"]["run"] for part in parts],
        "seeds": [part.record["run"]["seed"] for part in parts],
        "last": [part.last for part in parts],
        "frames": parts[0].frames,
    }
    settings = {name: value for name, value in first["run"].items() if name != "keep"}
    settings["runs"] = sum(part.record["run"]["runs"] for part in parts)
    draws, particles, stored = keep, first["kernel"]["particles"], first["run"].get("keep")
    if first.get("smoothing") or (draws is not None and draws >= particles):
        draws = None
    if stored:
        if draws is not None and draws < stored:
            show(f"note: the runs are thinned already: their {stored} draws of a frame are stored.")
        draws = stored
    return {**first, "run": settings | ({"keep": draws} if draws else {}), "chains": chains}


def _begin(out: Path, record: Record, show: Show) -> str:
    """Write `run.toml`, if it is not there, and remove the results of other runs. Return the id of the run.

    Raises:
        InputError: the folder has something that was not made by `combine_runs`.
    """
    for folder in (out, out / FRAMES_FOLDER):
        remove_partial(folder)
    if not (out / RUN_FILE).exists():
        refuse_occupied(out)
        return write_run_file(out, record)
    stored_record = read_run_file(out)
    if not stored_record.get("chains"):
        raise input_error(out, "a run of its own", "a new folder, or one of runs that were put together", "name another folder with --out")
    if stored_record["check"]["run"] != run_id(record):
        show(f"{out}: made anew, because its runs have changed or are others")
        _remove_results(out)
    elif {name: table for name, table in stored_record.items() if name != "check"} == record:
        return str(stored_record["check"]["run"])
    return write_run_file(out, record)


def _remove_results(out: Path) -> None:
    try:
        stills = read_manifest(out).stills
    except InputError:
        stills = []
    for name in (*stills, *RESULT_FILES):
        (out / name).unlink(missing_ok=True)


def _is_written(out: Path, run: str) -> bool:
    """Return whether the posterior is complete."""
    try:
        frames = FrameFiles(out / FRAMES_FOLDER, run)
        return len(frames) > 0 and Results(out, frames).is_current(POSTERIOR_FILE)
    except InputError:
        return False


def _finished(out: Path, run: str, pictures: bool) -> dict[str, Any] | None:
    """Return the content of `summary.json` if nothing is left to do, else None."""
    if not _is_written(out, run):
        return None
    results = Results(out, FrameFiles(out / FRAMES_FOLDER, run))
    if not results.is_current(SUMMARY_FILE) or (pictures and not results.is_drawn()):
        return None
    return json.loads((out / SUMMARY_FILE).read_text(encoding="utf-8"))


class JoinedFrames:
    """The frames of several runs, each with the chains of all; and what an index of them has.

    Args:
        sources: the frames of each run, in the order of time.
        run: the id of the run that they become.
        transition: the model's, which knows where the variables live.
        draws: number of draws of a frame and run; None for all.
    """

    def __init__(self, sources: Sequence[Frames], run: str, transition: Transition, draws: int | None):
        self.sources, self.run, self.transition, self.draws = sources, run, transition, draws
        # Filled as the frames are read, from the first to the last.
        self.entries = Entries()
        self._read = lru_cache(2)(self._join)

    def __len__(self) -> int:
        return len(self.sources[0])

    def __getitem__(self, index: int, /) -> FrameResult:
        if not -len(self) <= index < len(self):
            raise IndexError(index)
        return self._read(index % len(self))

    def __iter__(self) -> Iterator[FrameResult]:
        return (self[index] for index in range(len(self)))

    def archive(self, posterior: Path) -> FrameArchive:
        """Return the index of the frames, given the posterior that was written of them."""
        for index in range(len(self.entries), len(self)):
            self._join(index)
        names = in_posterior(arrays_of(self[0], Place(self.run, 0, "")))
        return FrameArchive(posterior, self.run, names, self.entries, last_first=False, trusted=True)

    def _join(self, index: int) -> FrameResult:
        frames = [source[index] for source in self.sources]
        spaces = {name: self.transition.space(name, values.shape[2:]) for name, values in frames[0].states.items()}
        frame = joined(frames, index, spaces)
        # The figures of runs that are thinned already are those of all particles.
        if self.draws is not None and not frame.figures:
            frame = thinned(frame, index, self.draws, spaces)
        if index == len(self.entries):
            place = Place(self.run, index, self.entries[index - 1].digest if index else "")
            digest = digest_of(arrays_of(frame, place))
            self.entries.append(Entry(digest, frame.seconds, frame.seconds_ready, np.asarray(frame.restarted, bool)))
        return frame


def _write(out: Path, run: str, record: Record, runs: Sequence[SavedRun], bar: bool) -> None:
    """Write the posterior and the index of the frames.

    Raises:
        InputError: a frame of a run is damaged, or the disk is full.
    """
    first = runs[0]
    sources: list[Frames] = [FrameFiles(run.folder / FRAMES_FOLDER, run.id) for run in runs]
    if first.smoothed:
        sources = [LastFirst(source) for source in sources]
    frames = JoinedFrames(sources, run, first.model.transition, record["run"].get("keep"))
    (out / FRAMES_FOLDER / INDEX_FILE).unlink(missing_ok=True)
    attributes = {"seeds": record["chains"]["seeds"]}
    stream_posterior(_draws(first, frames, Timing(0.0, 0.0)), out / POSTERIOR_FILE, attributes, watched("putting the runs together", bar))
    (out / FRAMES_FOLDER).mkdir(exist_ok=True)
    frames.archive(out / POSTERIOR_FILE).write(out / FRAMES_FOLDER)
    Results(out, FrameFiles(out / FRAMES_FOLDER, run)).add(POSTERIOR_FILE)


def _draws(first: SavedRun, frames: Frames, timing: Timing) -> Draws:
    cameras, is_sample = tuple(view.camera.name for view in first.session.views), declared_sample(first.tree)
    kernel = str(first.kernel["kind"])
    return Draws(first.model, frames, timing, cameras, first.first_frame, kernel, declared_sample=is_sample, smoothed=first.smoothed)


def _finish(out: Path, run: str, runs: Sequence[SavedRun], show: Show, bar: bool, pictures: bool) -> dict[str, Any]:
    """Write the summary and the pictures."""
    first, frames = runs[0], FrameFiles(out / FRAMES_FOLDER, run)
    figures, seeds = {"kernel": str(first.kernel["kind"]), "seed": first.settings["seed"]}, [run.settings["seed"] for run in runs]
    draws, remarks = _draws(first, frames, timing_of(frames)), list(first.summary.get("frame_pairs") or [])
    return finish(first.session, draws, Results(out, frames), figures, remarks, show, bar, smoothed=first.smoothed, pictures=pictures, seeds=seeds)
