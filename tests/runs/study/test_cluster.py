"""A study on a cluster: workers that come, die and end, a scheduler that goes, a batch system, ssh. Units are stubs that load no JAX."""

import os
import signal
import sys
from collections import Counter
from contextlib import contextmanager

import pytest

from bayes_body.base.errors import InputError
from bayes_body.runs.study import batch_jobs, cluster, dask_workers, host
from bayes_body.runs.study.driver import Driver
from bayes_body.runs.study.driver_file import DriverFile
from bayes_body.runs.study.records import STOPPED, UnitFiles
from bayes_body.runs.study.units import units_of
from bayes_body.runs.study.worker import Inspection, run_job, stop_jobs

from .dask_processes import SBATCH, SCANCEL, SSH, STUB, dask_processes, is_alive, program, study_of, wait_until

EVENTLESS = "nothing has happened"


@contextmanager
def started(study, out, lines, on_event=lambda event: None):
    """The driver of a study on its cluster, and its places."""
    units = units_of(study, out)
    with cluster.cluster_places(study, out, lines.append, STUB) as (places, share):
        yield Driver(units, out, places, share, lines.append, on_event), places


def computed(folder):
    """The frames that were computed, as often as they were."""
    return Counter(f"{path.parent.name} {line}" for path in folder.glob("*/computed") for line in path.read_text().splitlines())


def frames_of(sessions, runs=1):
    return Counter(f"{session} run_{run} {frame}" for session in sessions for run in range(1, runs + 1) for frame in range(3))


def processes_of(out):
    return {record.process for path in out.glob(".study/*/*.json") if (record := UnitFiles(out, path.parent.name, path.stem).read())}


@pytest.fixture(scope="module")
def running(tmp_path_factory):
    """A scheduler with two workers that are started again when they die."""
    with dask_processes(tmp_path_factory.mktemp("dask")) as processes:
        processes.worker(), processes.worker()
        processes.wait_for(workers=2)
        yield processes


@pytest.mark.slow
def test_units_on_two_workers_end_as_on_one_machine(running, tmp_path, capfd):
    study, out, lines = study_of(tmp_path, ["north", "south", "fails"], cluster=str(running.file), runs=2), tmp_path / "runs", []
    with started(study, out, lines) as (driver, _):
        driver.run()
    assert driver.done == {f"{session}/{unit}" for session in ("north", "south") for unit in ("run_1", "run_2", "closing")}
    assert set(driver.failures) == {"fails/run_1", "fails/run_2"}
    assert all("a stub that fails; expected another" in sentence for sentence in driver.failures.values())
    assert computed(tmp_path) == frames_of(["north", "south"], runs=2)
    assert any("2 units at once on 2 workers of tcp://127.0.0.1" in line for line in lines)
    # The file by which workers are tested is gone, and Dask has said nothing.
    assert not list(out.glob(".study/driver-*")) and capfd.readouterr() == ("", "")
    with started(study, out, lines) as (driver, _):
        assert driver.done == {f"{session}/{unit}" for session in ("north", "south") for unit in ("run_1", "run_2", "closing")}


@pytest.mark.slow
def test_a_unit_that_kills_its_workers_fails_and_the_others_finish(running, tmp_path):
    study, out, lines = study_of(tmp_path, ["north", "kills", "south"], cluster=running.address, retries=2), tmp_path / "runs", []
    with started(study, out, lines) as (driver, _):
        driver.run()
    assert driver.done == {"north/run_1", "south/run_1"}
    assert driver.failures["kills/run_1"].startswith("2 processes died one after the other without a new frame")
    assert sum("its worker" in line and "begins again after its last frame" in line for line in lines) == 2


@pytest.mark.slow
def test_workers_that_cannot_compute_are_no_places(running, tmp_path):
    study = study_of(tmp_path, ["north"], cluster=running.address, gpus=1)
    with pytest.raises(InputError, match=r"worker tcp://.*: no GPU that JAX could use"), started(study, tmp_path / "runs", []) as (driver, _):
        driver.run()


@pytest.mark.slow
def test_ctrl_c_ends_the_units_on_the_workers(running, tmp_path):
    study, out = study_of(tmp_path, ["waits_1", "waits_2"], cluster=running.address, at_once=1), tmp_path / "runs"

    def interrupt(event):
        assert event.running <= 1
        if any(path.is_dir() for path in out.glob("*/run_1/frames")):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), started(study, out, [], interrupt) as (driver, _):
        driver.run()
    (process,) = processes_of(out)
    wait_until(lambda: not is_alive(process), "the unit goes on")


@pytest.mark.slow
def test_workers_that_are_killed_and_restarted_in_the_middle(tmp_path):
    sessions = [f"walk_{number}" for number in range(6)]
    with dask_processes(tmp_path / "dask") as processes:
        workers = [processes.worker("--no-nanny"), processes.worker()]
        study, out, lines = study_of(tmp_path, sessions, cluster=processes.address), tmp_path / "runs", []
        doings = iter([lambda: os.kill(workers[0].pid, signal.SIGKILL), lambda: workers[1].terminate(), lambda: processes.worker()])

        def disturb(event):
            if event.unit is not None or (event.running == 0 and workers[1].poll() is not None):
                next(doings, int)()

        with started(study, out, lines, disturb) as (driver, _):
            driver.run()
    assert next(doings, EVENTLESS) == EVENTLESS
    assert driver.done == {f"{name}/run_1" for name in sessions} and not driver.failures
    # A unit whose worker died went on after its last frame; the one that was stored just then may have been computed twice.
    assert set(computed(tmp_path)) == set(frames_of(sessions)) and computed(tmp_path).total() <= len(frames_of(sessions)) + 2
    assert any("has gone" in line for line in lines)


@pytest.mark.slow
def test_a_scheduler_that_goes_away_is_a_sentence_and_its_units_end(tmp_path, monkeypatch):
    monkeypatch.setattr(dask_workers, "LOST_S", 3)
    study, out = None, tmp_path / "runs"
    with dask_processes(tmp_path / "dask") as processes:
        processes.worker()
        study = study_of(tmp_path, ["waits"], cluster=processes.address)

        def kill(event):
            if (out / "waits/run_1/frames").is_dir():
                processes.scheduler.kill()

        with (
            pytest.raises(InputError, match=r"tcp://127.*: its scheduler has gone; .*repeat the command"),
            started(study, out, [], kill) as (driver, _),
        ):
            driver.run()
    (process,) = processes_of(out)
    wait_until(lambda: not is_alive(process), "the unit goes on")


LAB = """
kind = "dask-slurm"
cpus = 1
memory = "500 MB"
time = "0:20:00"
at_once = 2
retries = 3
interface = "lo"
[slurm]
partition = "long"
account = "gait"
extra = ["#SBATCH --qos=high"]
setup = ["export FROM_SETUP=yes", "test -n \\"$FROM_SETUP\\" || exit 1"]
"""


def slurm(folder, monkeypatch, most=100):
    """A batch system whose jobs are processes of this machine; it refuses jobs after some."""
    jobs = folder / "jobs"
    jobs.mkdir()
    program(folder / "bin/sbatch", SBATCH, folder=str(jobs), most=most)
    program(folder / "bin/scancel", SCANCEL, folder=str(jobs))
    monkeypatch.setenv("PATH", f"{folder / 'bin'}:{os.environ['PATH']}")
    (folder / "lab.toml").write_text(LAB)
    return jobs, str(folder / "lab.toml")


@pytest.mark.slow
def test_jobs_of_slurm_compute_a_study(tmp_path, monkeypatch, capfd):
    jobs, lab = slurm(tmp_path, monkeypatch)
    study, out, lines = study_of(tmp_path, ["north", "south", "fails"], cluster=lab), tmp_path / "runs", []
    with started(study, out, lines) as (driver, _):
        driver.run()
    assert driver.done == {"north/run_1", "south/run_1"} and list(driver.failures) == ["fails/run_1"]
    scripts = [path.read_text() for path in sorted(jobs.glob("*.sh"))]
    assert len(scripts) == 2
    wanted = ["-p long", "-A gait", "-n 1", "--cpus-per-task=1", "--mem=477M", "-t 0:20:00", "--qos=high"]
    assert [f"#SBATCH {line}" in scripts[0] for line in wanted] == [True] * len(wanted), scripts[0]
    assert scripts[0].index("export FROM_SETUP=yes") < scripts[0].index(f"{sys.executable} -m distributed.cli.dask_worker tls://127.0.0.1")
    # Jobs end before their time is over, and with the study; certificates are gone.
    assert "--lifetime 1080s" in scripts[0]
    numbers = [int(path.read_text()) for path in jobs.glob("*.pid")]
    wait_until(lambda: not any(map(is_alive, numbers)), "a job goes on")
    assert not list(out.glob(".study/jobs/keys-*")) and capfd.readouterr() == ("", "")


@pytest.mark.slow
def test_jobs_that_slurm_refuses(tmp_path, monkeypatch):
    _, lab = slurm(tmp_path, monkeypatch, most=0)
    study = study_of(tmp_path, ["north", "south"], cluster=lab)
    words = r"lab\.toml: sbatch refuses the job: sbatch: error: invalid partition specified: nosuch; expected"
    with pytest.raises(InputError, match=words), started(study, tmp_path / "runs", []) as (driver, _):
        driver.run()


@pytest.mark.slow
def test_a_limit_of_slurm_is_kept(tmp_path, monkeypatch):
    _, lab = slurm(tmp_path, monkeypatch, most=1)
    names = ["waits_1", "waits_2"]
    study, lines, said = study_of(tmp_path, names, cluster=lab), [], "note: sbatch accepts no more than 1 jobs: sbatch: error"

    def go_on(event):
        # Units go on once the second job was refused.
        if any(line.startswith(said) for line in lines):
            for path in tmp_path.glob("waits_*/waits*"):
                path.unlink()

    with started(study, tmp_path / "runs", lines, go_on) as (driver, _):
        driver.run()
    assert driver.done == {f"{name}/run_1" for name in names}


@pytest.mark.slow
def test_a_batch_system_that_accepts_no_more_jobs_is_a_sentence(tmp_path, monkeypatch):
    monkeypatch.setattr(batch_jobs, "AGAIN_S", 0.2)
    jobs, lab = slurm(tmp_path, monkeypatch, most=1)
    study = study_of(tmp_path, ["waits"], cluster=lab)

    def end_the_job(event):
        if event.running:
            for path in jobs.glob("*.pid"):
                os.killpg(int(path.read_text()), signal.SIGKILL)
                path.unlink()

    with (
        pytest.raises(InputError, match="sbatch refuses the job: sbatch: error: invalid partition"),
        started(study, tmp_path / "runs", [], end_the_job) as (driver, _),
    ):
        driver.run()


def test_without_a_batch_system_the_sentence_says_where_to_go(tmp_path, monkeypatch):
    (tmp_path / "lab.toml").write_text(LAB)
    monkeypatch.setenv("PATH", str(tmp_path))
    study = study_of(tmp_path, ["north"], cluster=str(tmp_path / "lab.toml"))
    with pytest.raises(InputError, match=r"there is no `sbatch` on this machine.*login node"), started(study, tmp_path / "runs", []):
        pass


@pytest.mark.slow
def test_workers_by_ssh(tmp_path, monkeypatch):
    program(tmp_path / "bin/ssh", SSH, folder=str(tmp_path))
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:{os.environ['PATH']}")
    lab = tmp_path / "lab.toml"
    table = 'kind = "ssh"\ninterface = "lo"\nat_once = 1\n[ssh]\nuser = "ann"\nhosts = '
    lab.write_text(f'{table}["this", "nowhere"]')
    study, out, lines = study_of(tmp_path, ["north", "south"], cluster=str(lab)), tmp_path / "runs", []
    with started(study, out, lines) as (driver, _):
        driver.run()
    assert driver.done == {"north/run_1", "south/run_1"}
    assert "note: the worker on nowhere: ssh: Could not resolve hostname nowhere" in lines
    assert "BatchMode=yes" in (tmp_path / "ssh.txt").read_text() and "-l ann -- this" in (tmp_path / "ssh.txt").read_text()
    assert not list(out.glob(".study/*.pem"))
    lab.write_text(f'{table}["nowhere"]')
    with pytest.raises(InputError, match="no worker by ssh: nowhere: ssh: Could not resolve"), started(study, tmp_path / "other", []) as (driver, _):
        driver.run()


@pytest.mark.slow
def test_a_worker_whose_time_is_over_gives_its_unit_back(tmp_path):
    with dask_processes(tmp_path / "dask") as processes:
        study, out, lines, workers = study_of(tmp_path, ["waits"], cluster=processes.address), tmp_path / "runs", [], []

        def note(event):
            if any("waits/run_1: its worker" in line and "its time was over" in line for line in lines):
                raise KeyboardInterrupt
            if not workers or workers[-1].poll() is not None:
                workers.append(processes.worker("--lifetime", "8s"))

        with pytest.raises(KeyboardInterrupt), started(study, out, lines, note) as (driver, _):
            driver.run()
    (process,) = processes_of(out)
    wait_until(lambda: not is_alive(process), "the unit goes on")


def reply(file, **changes):
    return Inspection("worker-1", "node07", "0.1.0", file.token, "seen", 0, None)._replace(**changes)


def test_a_worker_that_cannot_compute_is_described(tmp_path):
    file = DriverFile(tmp_path, "0.1.0")
    assert file.fault("tcp://a:1", reply(file)) is None and file.remark(reply(file)) == ""
    faults = {
        "bayes-body 0.0.9; expected bayes-body 0.1.0, as here": reply(file, version="0.0.9"),
        "does not see": reply(file, token="", lock=""),
        "cannot lock files": reply(file, lock="[Errno 38] Function not implemented"),
        "cannot load bayes_body": ModuleNotFoundError("No module named 'bayes_body'"),
        "does not answer": TimeoutError("timed out after 20 s."),
    }
    for words, answer in faults.items():
        assert words in file.fault("tcp://a:1", answer)
    assert "no GPU that JAX could use" in file.fault("tcp://a:1", reply(file), gpus=1)
    # A network disk shows the file some seconds later; a package that is missing stays so.
    assert [file.may_change(answer) for answer in faults.values()] == [False, True, False, False, True]
    assert "do not start the study twice at once" in file.remark(reply(file, lock="free"))
    file.close()
    assert not list((tmp_path / ".study").iterdir())


def test_a_gpu_has_one_lock_whatever_number_a_job_gives_it(tmp_path, monkeypatch):
    lines = "GPU 0: NVIDIA H200 (UUID: GPU-aa)\\n  MIG 1g.18gb Device 0: (UUID: MIG-cc)\\nGPU 1: NVIDIA H200 (UUID: GPU-bb)"
    program(tmp_path / "bin/nvidia-smi", f"#!{{python}}\nprint('{lines}')\n")
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    assert host.gpu_identities(["1", "MIG-cc", "7"]) == {"GPU-bb": "1", "MIG-cc": "MIG-cc", "7": "7"}


def test_a_driver_that_has_stopped_begins_no_unit(tmp_path):
    stop_jobs("token")
    from bayes_body.runs.study.unit_process import Job

    job = Job(str(tmp_path), "walk", "run_1", (), str(tmp_path / "walk/run_1"), "", "", ())
    assert run_job(job.to_text(), "token").state == STOPPED and not (tmp_path / ".study").exists()
