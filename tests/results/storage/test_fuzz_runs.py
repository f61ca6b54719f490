"""Damaged folders of runs: whatever is done to a file, reading gives what the run wrote or says what is wrong, soon and without a trace elsewhere."""

import dataclasses
import hashlib
import random
import resource
import shutil
import signal
from contextlib import contextmanager

import numpy as np
import pytest
from mutations import mutated
from sealed import seal

from bayes_body.base.errors import InputError
from bayes_body.recording.session.read import save_session
from bayes_body.results.storage import FrameFiles
from bayes_body.results.storage.run_file import read_record
from bayes_body.results.storage.saved_run import load_run
from bayes_body.runs.run import run
from bayes_body.runs.settings import Settings, stored_record

QUICK, MORE, MANY = 30, 150, 10_000
FRAMES = 4
# Files with many bytes are not more interesting than others.
NAMES = ("run.toml", "summary.json", "manifest.json", "posterior.nc", "frames/index.npz")
SECONDS, MEMORY_BYTES = 10, 2 * 2**30


@contextmanager
def soon():
    """A block that takes at most ten seconds of the processor; a reader without end is an error, not a test that never ends."""

    def late(number, frame):
        raise TimeoutError(f"no end after {SECONDS} s of the processor")

    before = signal.signal(signal.SIGPROF, late)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


@pytest.fixture(scope="module")
def place(textured_session, tmp_path_factory):
    """A folder with a run and a file that is none of its business."""
    folder = tmp_path_factory.mktemp("fuzzed")
    shutil.copytree(textured_session.folder, folder / "session")
    save_session(dataclasses.replace(textured_session, folder=folder / "session"))
    options = {"model": "arm", "overrides": {"particles": 20}, "runs": 2, "seed": 3, "frames": FRAMES}
    run(Settings(folder / "session", folder / "run", **options), lambda line: None, bar=False)
    (folder / "victim").write_text("precious")
    return folder


def read(folder):
    """Everything that `report`, `export` and `track --resume` take from a run, as one digest each; None for what is refused with a sentence."""
    return {"results": _or_none(_results, folder), "frames": _or_none(_frames, folder)}


def _or_none(reader, folder):
    try:
        return reader(folder)
    except InputError as error:
        said = str(error)
    # Sentences that can be read.
    assert said and len(said) < 2000 * len(said.splitlines())
    return None


def _results(folder):
    found = hashlib.sha256()
    with load_run(folder) as saved:
        tables = (saved.settings, saved.kernel, saved.versions, saved.texts, saved.summary, saved.first_pose, saved.inputs, saved.spaces)
        found.update(repr([sorted(dict(table).items()) for table in tables]).encode())
        assert saved.model.body.dof_names
        for group in saved.tree.subtree:
            for name, array in sorted(group.to_dataset().variables.items()):
                found.update(f"{group.path} {name} {array.dims} {array.attrs}".encode() + np.asarray(array).tobytes())
    return found.hexdigest()


def _frames(folder):
    """The frames with which a run would go on; fewer are computed again."""
    record = stored_record(Settings(folder, folder, resume=True))
    files = FrameFiles(folder / "frames", read_record(folder)["check"]["run"])
    files.mend()
    return repr(sorted(record["run"].items())), [(frame.states["pose"].tobytes(), frame.log_weights.tobytes(), frame.seconds) for frame in files]


def same(found, whole):
    """Whether nothing is other than it was: the same results or none, the same settings and the first of the frames or none."""
    settings, frames = found["frames"] or (whole["frames"][0], [])
    return found["results"] in (None, whole["results"]) and settings == whole["frames"][0] and frames == whole["frames"][1][: len(frames)]


def _peak_bytes():
    """The largest memory of this process so far, other tests included."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _around(place):
    return {str(path.relative_to(place)): path.stat().st_mtime_ns for path in place.rglob("*")}


def _fuzz(place, cases, seed):
    rng, folder = random.Random(seed), place / "run"
    whole = read(folder)
    assert whole["results"] and len(whole["frames"][1]) == FRAMES
    sound = {name: (folder / name).read_bytes() for name in NAMES}
    refused, peak = 0, _peak_bytes()
    for case in range(cases):
        name = rng.choice(NAMES)
        damaged = sound[rng.choice(NAMES)] if rng.random() < 0.02 else mutated(sound[name], rng)
        (folder / name).write_bytes(damaged)
        before = _around(place)
        with soon():
            found = read(folder)
        assert same(found, whole), (case, name)
        assert _around(place) == before and (place / "victim").read_text() == "precious"
        refused += found["results"] is None or len(found["frames"] or ((), ())[1]) < FRAMES
        (folder / name).write_bytes(sound[name])
    assert refused > 0.5 * cases
    assert _peak_bytes() - peak < MEMORY_BYTES


@pytest.mark.slow
def test_some_mutations(place):
    _fuzz(place, QUICK, seed=1)


@pytest.mark.long
def test_more_mutations(place):
    _fuzz(place, MORE, seed=5)


@pytest.mark.long
def test_ten_thousand_mutations(place):
    _fuzz(place, MANY, seed=2)


@pytest.mark.long
def test_mutations_that_are_sealed_again(place, tmp_path):
    """By somebody who makes all digests right: there may be other numbers, but no error of another kind, no endless reading, and no trace."""
    rng, folder = random.Random(3), tmp_path / "place" / "run"
    shutil.copytree(place, tmp_path / "place")
    sound = {name: (folder / name).read_bytes() for name in ("run.toml", "summary.json", "posterior.nc")}
    for _ in range(500):
        name = rng.choice(list(sound))
        (folder / name).write_bytes(mutated(sound[name], rng))
        try:
            seal(folder, FRAMES)
        except ValueError:
            # What is no TOML cannot be sealed.
            assert name == "run.toml"
        before = _around(tmp_path / "place")
        with soon():
            read(folder)
        assert _around(tmp_path / "place") == before
        (folder / name).write_bytes(sound[name])
        seal(folder, FRAMES)


@pytest.mark.long
def test_a_damaged_run_that_goes_on_ends_as_it_was(place, tmp_path):
    rng, whole = random.Random(4), (place / "run" / "posterior.nc").read_bytes()
    for case in range(12):
        out = shutil.copytree(place / "run", tmp_path / f"run{case}")
        name = rng.choice(NAMES)
        (out / name).write_bytes(mutated((out / name).read_bytes(), rng))
        try:
            run(Settings(place / "session", out, resume=True), lambda line: None, bar=False)
        except InputError:
            # Only the settings cannot be made again.
            assert name == "run.toml"
        else:
            assert (out / "posterior.nc").read_bytes() == whole, (case, name)
