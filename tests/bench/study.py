"""A study of short simulated walks: its wall time against that of its units alone, and the same study killed again and again.

`python tests/bench/study.py [--sessions 20] [--runs 2] [--kills 10] [--work FOLDER]`. The keypoints have outliers and
gaps, as those of a network do; the truth is known.
"""

import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from keypoint_walks import Network, person_of, shipped_walk, walk_session

from bayes_body.recording.session.read import save_session
from bayes_body.recording.session.session import View
from bayes_body.runs.study.study_file import StudyFile
from bayes_body.runs.study.units import units_of

PROGRAM = [sys.executable, "-m", "bayes_body.cli.main"]
PARTICLES = 200
UNIT = "bayes_body.cli.unit"


def make_sessions(folder: Path, count: int, frames: int) -> list[Path]:
    """Write sessions of different people."""
    folders = [folder / f"walk_{number:02d}" for number in range(count)]
    for number, session in enumerate(folders):
        if not (session / "session.toml").exists():
            made, _ = walk_session(session, person_of(shipped_walk(frames, number), False), Network(outliers=0.02, missing=0.05, seed=number))
            save_session(replace(made, views=tuple(with_pictures(session, view, frames) for view in made.views)))
    return folders


def with_pictures(session: Path, view: View, frames: int) -> View:
    """Return the view with an empty picture for each frame: all are one file."""
    blank = session / view.images.replace("%.0s", "")
    for frame in range(frames):
        os.link(blank, session / f"{blank.stem}_{frame:04d}{blank.suffix}")
    return replace(view, images=f"{blank.stem}_%04d{blank.suffix}")


def study(sessions: list[Path], out: Path, runs: int) -> subprocess.Popen:
    command = [*PROGRAM, "track", *map(str, sessions), "--out", str(out), "--runs", str(runs), "--particles", str(PARTICLES), "--no-pictures"]
    return subprocess.Popen(command, stdout=(out.parent / f"{out.name}.txt").open("a"), stderr=subprocess.STDOUT, start_new_session=True)


def alone(out: Path, sessions: list[Path], runs: int) -> float:
    """Run the commands of all units by themselves, one after the other, each on one core. Return the seconds."""
    table = {"sessions": [str(session) for session in sessions], "runs": runs, "particles": PARTICLES, "pictures": False}
    environment = os.environ | {"XLA_FLAGS": "--xla_force_host_platform_device_count=1"}
    begun = time.perf_counter()
    for unit in units_of(StudyFile.model_validate(table), out):
        for command in unit.commands:
            subprocess.run(
                ["taskset", "-c", "0", *PROGRAM, *command], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment
            )
    return time.perf_counter() - begun


def units_running() -> list[int]:
    listed = subprocess.run(["pgrep", "-f", UNIT], capture_output=True, text=True).stdout.split()
    return [int(number) for number in listed]


def killed_study(sessions: list[Path], out: Path, runs: int, kills: int, every_s: float, seed: int) -> int:
    """Kill the driver or a unit with SIGKILL at random moments, start again until all is done; return how many kills there were."""
    chance, killed = random.Random(seed), 0
    while True:
        driver = study(sessions, out, runs)
        while driver.poll() is None:
            try:
                driver.wait(chance.uniform(0.3, 1.7) * every_s)
            except subprocess.TimeoutExpired:
                if killed >= kills:
                    continue
                units = units_running()
                if units and chance.random() < 0.5:
                    os.kill(chance.choice(units), signal.SIGKILL)
                    print(f"  a unit was killed ({killed + 1})", flush=True)
                else:
                    driver.kill()
                    print(f"  the driver was killed ({killed + 1})", flush=True)
                killed += 1
        if driver.returncode >= 0:
            return killed


def arrays(run: Path) -> dict[str, np.ndarray]:
    import xarray as xr

    with xr.open_datatree(run / "posterior.nc", engine="h5netcdf") as tree:
        return {
            f"{group}/{name}": np.asarray(values)
            for group in ("posterior", "sample_stats")
            for name, values in tree[group].data_vars.items()
            # Of the clock.
            if "seconds" not in name
        }


def differing(one: Path, other: Path) -> list[str]:
    """Return the runs whose posteriors are not equal bit for bit."""
    names = [path.parent.relative_to(one) for path in sorted(one.glob("*/run_*/posterior.nc"))]
    different = []
    for name in names:
        left, right = arrays(one / name), arrays(other / name)
        if left.keys() != right.keys() or any(left[key].tobytes() != right[key].tobytes() for key in left):
            different.append(str(name))
    print(f"{len(names)} posteriors compared, {len(different)} differ")
    return different


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sessions", type=int, default=20)
    parser.add_argument("--runs", type=int, default=2)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--work", type=Path, default=Path("study_bench"))
    options = parser.parse_args()
    work = options.work.resolve()
    sessions = make_sessions(work / "sessions", options.sessions, options.frames)
    for name in ("warm", "single", "whole", "killed"):
        shutil.rmtree(work / name, ignore_errors=True)
    # Programs are compiled before anything is timed: both sides take them from the cache.
    assert study(sessions[:1], work / "warm", options.runs).wait() == 0
    single_s, cores = alone(work / "single", sessions, options.runs), len(os.sched_getaffinity(0))
    begun = time.perf_counter()
    assert study(sessions, work / "whole", options.runs).wait() == 0
    whole_s = time.perf_counter() - begun
    print(
        f"{single_s:.0f} s on one core, {whole_s:.0f} s on {cores}: {whole_s / (single_s / cores):.2f} of the units' sum divided by {cores}",
        flush=True,
    )
    if options.kills:
        every_s = whole_s / (options.kills + 1)
        killed = killed_study(sessions, work / "killed", options.runs, options.kills, every_s, options.seed)
        print(f"killed {killed} times")
        assert not differing(work / "whole", work / "killed")


if __name__ == "__main__":
    main()
