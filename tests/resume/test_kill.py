"""kill -9 at any moment: the run that is continued ends as one that was never stopped, bit for bit."""

import random
import signal
import subprocess
import time
from collections import Counter

import pytest

from bayes_body.results.storage import FrameFiles
from bayes_body.results.storage.run_file import read_record
from bayes_body.runs.run import run
from bayes_body.runs.settings import Settings

from .conftest import command, contents, track

FRAMES, PARTICLES = 40, 40
OPTIONS = ["--particles", PARTICLES, "--runs", 2]


@pytest.fixture(scope="module")
def uninterrupted(looped, tmp_path_factory):
    out = tmp_path_factory.mktemp("whole") / "run"
    run(Settings(looped(FRAMES), out, "arm", None, {"particles": PARTICLES}, 2), lambda line: None, bar=False)
    return contents(out / "posterior.nc")


def finish(session, out):
    # All options, as `start` has it: a run that was killed before it wrote anything knows none.
    run(Settings(session, out, "arm", None, {"particles": PARTICLES}, 2, resume=True), lambda line: None, bar=False)
    return contents(out / "posterior.nc")


def kill_when(started, moment) -> bool:
    """Kill the process once `moment()` is true; whether it was still at work."""
    with started as process:
        while process.poll() is None and not moment():
            time.sleep(0.0005)
        process.kill()
    return process.returncode == -9


def start(session, out):
    resume = ["--resume"] if out.exists() else []
    return subprocess.Popen(command(session, out, *OPTIONS, *resume), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


@pytest.mark.long
def test_killed_among_the_frames_twice(looped, tmp_path, uninterrupted):
    out, killed = tmp_path / "run", []
    for frame in (9, 31):
        killed.append(kill_when(start(looped(FRAMES), out), (out / "frames" / f"{frame:06d}.npz").exists))
        assert frame < len(FrameFiles(out / "frames")) <= FRAMES
    # A machine so fast that the run was through proves nothing, but fails nothing either.
    assert killed[0] or len(FrameFiles(out / "frames")) == FRAMES
    assert finish(looped(FRAMES), out) == uninterrupted


@pytest.mark.long
def test_killed_a_hundred_times_at_any_moment(looped, tmp_path, uninterrupted):
    rng = random.Random(20)
    begun = time.monotonic()
    assert track(looped(FRAMES), tmp_path / "timed", *OPTIONS).returncode == 0
    whole = time.monotonic() - begun
    out, phases = tmp_path / "run0", Counter()
    for number in range(1000):
        until = time.monotonic() + rng.uniform(0.1, 1.0) * whole
        if kill_when(start(looped(FRAMES), out), lambda until=until: time.monotonic() > until):
            phases[phase(out)] += 1
        # Drawing begins anew each time, and a run that is killed again and again would never come to its end.
        if phase(out) == "pictures" and rng.random() < 0.5:
            finish(looped(FRAMES), out)
        if phase(out) in ("finished", "removal"):
            assert contents(out / "posterior.nc") == uninterrupted
            out = tmp_path / f"run{number + 1}"
        if phases.total() == 100:
            break
    assert phases.total() == 100
    # The posterior is written within milliseconds: whether a kill hits it is the clock's choice.
    assert phases.keys() >= {"before the first frame", "frames", "pictures"}, phases
    print(dict(phases))
    assert finish(looped(FRAMES), out) == uninterrupted


def phase(out):
    """What a run was doing when it stopped."""
    if not (out / "frames").exists():
        return "before the first frame"
    if len(FrameFiles(out / "frames")) < FRAMES:
        return "frames"
    if not (out / "posterior.nc").exists():
        return "posterior"
    if "overlay.mp4" not in (out / "manifest.json").read_text():
        return "pictures"
    return "removal" if any((out / "frames").glob("[0-9]*.npz")) else "finished"


@pytest.mark.long
def test_twenty_pairs_of_processes_on_one_folder(looped, tmp_path, uninterrupted):
    """Of different seeds, begun and paused at random moments: one of them works, the other one is told so, and nothing is mixed."""
    rng = random.Random(5)
    session = looped(FRAMES)
    begun = time.monotonic()
    assert track(session, tmp_path / "other", *OPTIONS, "--seed", 1).returncode == 0
    whole = time.monotonic() - begun
    ends = {0: uninterrupted, 1: contents(tmp_path / "other" / "posterior.nc")}
    for number in range(20):
        out = tmp_path / f"run{number}"
        pair = []
        for seed in (0, 1):
            options = [*OPTIONS, "--seed", seed, *(["--resume"] if rng.random() < 0.5 else [])]
            pair.append(subprocess.Popen(command(session, out, *options), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True))
            time.sleep(rng.uniform(0, 0.5) * whole)
        for _ in range(4):
            paused = rng.choice(pair)
            paused.send_signal(signal.SIGSTOP)
            time.sleep(rng.uniform(0, 0.3) * whole)
            paused.send_signal(signal.SIGCONT)
        said = [process.communicate()[1] for process in pair]
        assert sorted(process.returncode for process in pair) == [0, 2], said
        assert any(
            sentence in "".join(said) for sentence in ("works on it", "holds a run that has", "cannot be continued", "which a run would replace")
        ), said
        assert contents(out / "posterior.nc") == ends[read_record(out)["run"]["seed"]]


@pytest.mark.long
def test_an_interruption_says_how_to_go_on(looped, tmp_path):
    """Ctrl-C."""
    out = tmp_path / "run"
    # So many particles that the frames that are left take longer than the signal.
    slowly = ["--particles", 20_000, "--runs", 2]
    # Tests that a shell runs in the background inherit that Ctrl-C is ignored, and would hand it on.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    process = subprocess.Popen(command(looped(FRAMES), out, *slowly), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    signal.signal(signal.SIGINT, before)
    while process.poll() is None and not (out / "frames" / "000003.npz").exists():
        time.sleep(0.0005)
    process.send_signal(signal.SIGINT)
    said, errors = process.communicate()
    assert process.returncode == 130, errors
    assert "frames are kept; the same command with --resume continues from there." in said
    assert "interrupted" in errors and "Traceback" not in errors
