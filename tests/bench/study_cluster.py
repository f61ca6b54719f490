"""The study of `study.py` on clusters: the posteriors are those of this machine, bit for bit, whatever dies on the way.

`python tests/bench/study_cluster.py [--sessions 20] [--runs 2] [--on local workers slurm] [--work FOLDER]`. `local` is distributed.LocalCluster.
`workers` is a scheduler with two `dask worker`: the driver and a worker are killed, and a worker is restarted. `slurm` has an sbatch that starts
processes of this machine, with jobs of so many minutes (`--minutes`).
"""

import argparse
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "runs" / "study"))
from dask_processes import SBATCH, SCANCEL, dask_processes, program
from study import PARTICLES, PROGRAM, differing, make_sessions


def begin(sessions: list[Path], out: Path, runs: int, *options: str) -> subprocess.Popen:
    """Start the study; give each unit one core, as everywhere."""
    file, folders = out.with_suffix(".toml"), [str(session) for session in sessions]
    file.write_text(f"sessions = {folders}\nruns = {runs}\nparticles = {PARTICLES}\ncpus = 1\npictures = false\n")
    log = out.with_suffix(".txt").open("a")
    return subprocess.Popen([*PROGRAM, "study", str(file), *options], stdout=log, stderr=subprocess.STDOUT, start_new_session=True)


def on_local_cluster(sessions: list[Path], out: Path, runs: int, every_s: float) -> None:
    from distributed import LocalCluster

    with LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address="localhost:0") as cluster:
        assert begin(sessions, out, runs, "--cluster", cluster.scheduler_address).wait() == 0


def on_workers(sessions: list[Path], out: Path, runs: int, every_s: float) -> None:
    """Kill the driver, kill a worker, restart the other one, at three moments."""
    shutil.rmtree(out.parent / "dask", ignore_errors=True)
    with dask_processes(out.parent / "dask") as processes:
        first, second = processes.worker("--no-nanny"), processes.worker()
        driver = begin(sessions, out, runs, "--cluster", processes.address)
        time.sleep(every_s)
        driver.kill()
        driver = begin(sessions, out, runs, "--cluster", str(processes.file))
        time.sleep(every_s)
        first.kill()
        time.sleep(every_s)
        second.terminate()
        processes.worker(), processes.worker()
        assert driver.wait() == 0


def on_slurm(sessions: list[Path], out: Path, runs: int, minutes: int) -> None:
    jobs, bin_folder = out.parent / "jobs", out.parent / "bin"
    shutil.rmtree(jobs, ignore_errors=True)
    jobs.mkdir()
    program(bin_folder / "sbatch", SBATCH, folder=str(jobs), most=1000)
    program(bin_folder / "scancel", SCANCEL, folder=str(jobs))
    os.environ["PATH"] = f"{bin_folder}:{os.environ['PATH']}"
    lab = out.with_name("lab.toml")
    lab.write_text(f'kind = "dask-slurm"\nmemory = "4 GB"\ntime = "0:{minutes:02d}:00"\nat_once = 2\ninterface = "lo"\n')
    assert begin(sessions, out, runs, "--cluster", str(lab)).wait() == 0
    print(f"{len(list(jobs.glob('*.sh')))} jobs")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sessions", type=int, default=20)
    parser.add_argument("--runs", type=int, default=2)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--minutes", type=int, default=20)
    parser.add_argument("--on", nargs="+", choices=("local", "workers", "slurm"), default=["local", "workers", "slurm"])
    parser.add_argument("--work", type=Path, default=Path("study_bench"))
    options = parser.parse_args()
    work = options.work.resolve()
    sessions = make_sessions(work / "sessions", options.sessions, options.frames)
    for name in ("here", *options.on):
        shutil.rmtree(work / name, ignore_errors=True)
    begun = time.perf_counter()
    assert begin(sessions, work / "here", options.runs).wait() == 0
    here_s = time.perf_counter() - begun
    print(f"here       {here_s:.0f} s", flush=True)
    for name in options.on:
        begun = time.perf_counter()
        if name == "slurm":
            on_slurm(sessions, work / name, options.runs, options.minutes)
        else:
            {"local": on_local_cluster, "workers": on_workers}[name](sessions, work / name, options.runs, here_s / 5)
        print(f"{name:<10} {time.perf_counter() - begun:.0f} s", flush=True)
        assert not differing(work / "here", work / name)


if __name__ == "__main__":
    main()
