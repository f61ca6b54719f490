"""What the engine of a study costs by itself: 1000 sessions x 10 runs of a stub, 1 % of them failing. `python tests/bench/study_overhead.py`.

A stub reads its job, writes its state and a summary, and ends: no JAX, no commands. Reported: milliseconds a unit that are not the stubs' own, the
driver's memory, the size of index.html, and whether the page and `status` say which units failed.
"""

import argparse
import json
import re
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from bayes_body.runs.study.attempt import Attempts
from bayes_body.runs.study.driver import Driver, Share
from bayes_body.runs.study.overview import Overview
from bayes_body.runs.study.places import LocalPlaces
from bayes_body.runs.study.status import states_of
from bayes_body.runs.study.study_file import StudyFile
from bayes_body.runs.study.units import units_of

# What a finished run says, with the keys of a real one.
SUMMARY = {"frames": 2, "frames_lost": 0, "rhat_max": 1.01, "seconds_total": 1.0, "seconds_per_frame": 0.1, "warnings": ["a warning " * 9]}
STUB = f"""
import json, os, sys, time
from pathlib import Path
begun = time.time()
job = json.loads(sys.stdin.readline())
number = sum(map(ord, job["key"] if "key" in job else job["session"] + job["name"]))
fails = job["name"] == "run_7" and job["session"].endswith("7")
folder = Path(job["folder"])
folder.mkdir(parents=True, exist_ok=True)
if not fails:
    (folder / "summary.json").write_text({json.dumps(SUMMARY)!r})
record = dict(state="failed" if fails else "done", digest=job["digest"], work=job["work"], host="stub", process=os.getpid(), begun=begun, seconds=0.1,
              frames=0, deaths=0, sentence="the stub of run 7 always fails." if fails else "", peak_bytes=10**8, cache_hits=1, cache_misses=0)
(Path(job["out"]) / ".study" / job["session"] / (job["name"] + ".json")).write_text(json.dumps(record))
sys.exit(2 if fails else 0)
"""
SESSION = 'title = "stub"\nfps = 60.0\nframes = 2\n[[camera]]\nname = "C1"\nsize_px = [640, 480]\n'


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sessions", type=int, default=1000)
    parser.add_argument("--runs", type=int, default=10)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder, out = Path(temporary), Path(temporary) / "out"
        for number in range(options.sessions):
            session = folder / "sessions" / f"walk_{number:04d}"
            session.mkdir(parents=True)
            (session / "session.toml").write_text(SESSION)
        stub = folder / "stub.py"
        stub.write_text(STUB)
        program = ("-I", "-S", str(stub))
        begun = time.perf_counter()
        study = StudyFile(sessions=[str(path) for path in sorted((folder / "sessions").iterdir())], runs=options.runs)
        units = units_of(study, out)
        print(f"{len(units)} units planned in {time.perf_counter() - begun:.1f} s", flush=True)
        stub_s, places = alone(program, units[0], out), 2
        overview, begun = Overview(study, units, out), time.perf_counter()
        lines: list[str] = []
        driver = Driver(units, out, LocalPlaces(places, 1, Attempts(program)), Share(), lines.append, overview.note)
        driver.run()
        overview.write()
        ran = len(driver.done) + len(driver.failures)
        wall_s, own = time.perf_counter() - begun, resource.getrusage(resource.RUSAGE_SELF)
        print(f"{ran} units ran, {len(driver.failures)} failed, {len(units) - ran} wait for one that failed")
        print(f"wall time {wall_s:.1f} s: {1000 * (wall_s * places - ran * stub_s) / ran:.1f} ms a unit beyond the stub's {1000 * stub_s:.1f} ms")
        print(f"the driver's CPU time {1000 * (own.ru_utime + own.ru_stime) / ran:.1f} ms a unit, its memory {own.ru_maxrss / 1024:.0f} MB")
        page = (out / "index.html").read_text(encoding="utf-8")
        listed = sum(1 for key in driver.failures if key in page)
        print(f"index.html {len(page) / 1e6:.2f} MB, names {listed} of {len(driver.failures)} failures; {len(re.findall('<tr', page))} rows")
        begun = time.perf_counter()
        failed = [state for state in states_of(units, out) if state.state == "failed"]
        print(f"status: {len(failed)} failed, read in {time.perf_counter() - begun:.1f} s")


def alone(program: tuple[str, ...], unit, out: Path) -> float:
    """Seconds of one stub, the mean of some."""
    (out / ".study" / unit.session).mkdir(parents=True, exist_ok=True)
    job = {"session": unit.session, "name": "alone", "folder": str(out / "alone"), "out": str(out), "digest": "", "work": ""}
    begun, count = time.perf_counter(), 20
    for _ in range(count):
        subprocess.run([sys.executable, *program], input=json.dumps(job) + "\n", text=True, check=True)
    return (time.perf_counter() - begun) / count


if __name__ == "__main__":
    main()
