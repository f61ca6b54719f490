"""A cluster in writing: its faults are sentences, and each batch system gets its own form of memory, time and GPU."""

import sys

import pytest

from bayes_body.base.errors import InputError
from bayes_body.cli.main import main
from bayes_body.runs.study import cluster
from bayes_body.runs.study.cluster_file import memory_bytes, read_cluster_file, time_seconds

from .dask_processes import study_of

FAULTS = {
    'memory = "4 Go"': 'memory: "4 Go"; expected the memory of a unit, 100 MB or more, such as "4 GB" or "4 GiB"',
    'memory = "4 gb per core"': 'memory: "4 gb per core"; expected the memory of a unit',
    'memory = "4 MB"': 'memory: "4 MB"; expected the memory of a unit, 100 MB or more',
    "memory = 4": "memory = 4; expected a string; put it in double quotes",
    'time = "2 hours"': 'time: "2 hours"; expected hours:minutes:seconds',
    'time = "2:00"': 'time: "2:00"; expected hours:minutes:seconds',
    "gpus = 2": "gpus = 2; expected a number less than or equal to 1",
    "at_onc = 3": "at_onc: unknown key; did you mean 'at_once'?",
    '[pbs]\nqueue = "long"': "[pbs]: a table of another kind than dask-slurm; expected [slurm]; remove it, or correct `kind`",
    '[slurm]\npartitio = "long"': "slurm.partitio: unknown key; did you mean 'partition'?",
    '[slurm]\nsetup = ["a\\nb"]': "has control characters",
}


def written(folder, text):
    path = folder / "lab.toml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("line", FAULTS)
def test_a_fault_is_a_sentence_with_file_and_key(tmp_path, line):
    defaults = [text for text in ('memory = "4 GB"', 'time = "2:00:00"') if text.split()[0] != line.split()[0]]
    path = written(tmp_path, "\n".join(['kind = "dask-slurm"', *defaults, line]))
    with pytest.raises(InputError) as fault:
        read_cluster_file(path)
    assert str(fault.value).startswith(str(path)) and FAULTS[line] in str(fault.value)


def test_what_a_kind_needs_is_asked_for(tmp_path):
    with pytest.raises(InputError, match=r"(?s)memory: missing.*time: missing"):
        read_cluster_file(written(tmp_path, 'kind = "dask-slurm"'))
    with pytest.raises(InputError, match=r"\[ssh\]: missing; expected the machines"):
        read_cluster_file(written(tmp_path, 'kind = "ssh"'))
    with pytest.raises(InputError, match="did you mean 'dask-slurm'"):
        read_cluster_file(written(tmp_path, 'kind = "dask-slrm"'))


def test_memory_and_time_mean_what_slurm_means():
    assert memory_bytes("4 GB") == 4e9 and memory_bytes("4GiB") == 4 * 2**30 and memory_bytes("1500 M") == 1.5e9
    assert time_seconds("2:00:00") == 7200 and time_seconds("1-12:00:00") == 36 * 3600


SCRIPTS = {
    "dask-slurm": [
        "#SBATCH --cpus-per-task=2",
        "#SBATCH --mem=4G",
        "#SBATCH -t 1-12:00:00",
        "#SBATCH --gres=gpu:1",
        "#SBATCH --qos=long",
        "#SBATCH -A a",
    ],
    "dask-pbs": ["#PBS -l select=1:ncpus=2:mem=4096MB:ngpus=1", "#PBS -l walltime=36:00:00", "#PBS --qos=long", "#PBS -A a"],
    "dask-lsf": ["#BSUB -n 2", "#BSUB -W 36:00", '#BSUB -gpu "num=1"', "#BSUB --qos=long", '#BSUB -P "a"'],
    "dask-sge": ["#$ -l h_rt=36:00:00", "#$ --qos=long", "#$ -P a"],
    "dask-htcondor": ["request_gpus = 1", "accounting_group = a", "> 129600)", "--qos = long", "MY.DaskWorkerMemory = 4294967296"],
}


@pytest.mark.parametrize("kind", SCRIPTS)
def test_the_job_script_of_each_batch_system(tmp_path, kind):
    table = kind.removeprefix("dask-")
    lines = [f'kind = "{kind}"', "cpus = 2", 'memory = "4 GiB"', "gpus = 1", 'time = "1-12:00:00"', f"[{table}]"]
    lines += ['account = "a"', 'extra = ["--qos=long"]', 'setup = ["module load cuda"]']
    study = study_of(tmp_path, ["walk"], cluster=str(written(tmp_path, "\n".join(lines))))
    script = cluster.job_script(study)
    for line in [*SCRIPTS[kind], "module load cuda", f"{sys.executable} -m distributed.cli.dask_worker", "--nthreads 2", "--lifetime 129480s"]:
        assert line in script, script


def test_the_commands_of_ssh(tmp_path):
    text = 'kind = "ssh"\n[ssh]\nhosts = ["north", "south"]\nuser = "ann"\nport = 2222\npython = "/opt/venv/bin/python"'
    script = cluster.job_script(study_of(tmp_path, ["walk"], cluster=str(written(tmp_path, text))))
    assert [line.split(" -- ")[1].split()[0] for line in script.splitlines()] == ["north", "south"]
    assert "-l ann -p 2222" in script and "/opt/venv/bin/python -m distributed.cli.dask_worker" in script


def test_a_dry_run_prints_the_script_and_submits_nothing(tmp_path, capsys):
    (tmp_path / "walk").mkdir()
    (tmp_path / "walk/session.toml").write_text("frames = 3\n")
    (tmp_path / "gait.toml").write_text('sessions = ["walk"]\ncluster = "lab.toml"\n')
    written(tmp_path, 'kind = "dask-slurm"\nmemory = "4 GB"\ntime = "2:00:00"\n')
    with pytest.raises(SystemExit) as end:
        main(["study", str(tmp_path / "gait.toml"), "--dry-run"])
    assert end.value.code == 0 and "#SBATCH --mem=4G" in capsys.readouterr().out
    assert not (tmp_path / "gait").exists()


def test_a_running_cluster_has_no_job_script(tmp_path):
    assert "no job is submitted" in cluster.job_script(study_of(tmp_path, ["walk"], cluster="tcp://head:8786"))


@pytest.mark.parametrize("package", ["distributed", "dask_jobqueue", "cryptography"])
def test_without_the_extra_the_sentence_has_the_line_that_installs_it(tmp_path, monkeypatch, package):
    monkeypatch.setitem(sys.modules, package, None)
    study = study_of(tmp_path, ["walk"], cluster="tcp://head:8786")
    with (
        pytest.raises(InputError, match=r"Dask is not installed.*pip install 'bayes-body\[cluster\]'"),
        cluster.cluster_places(study, tmp_path, print),
    ):
        pass


def test_what_is_no_cluster_is_refused(tmp_path):
    (tmp_path / "other.json").write_text("{}")
    for described, words in (
        ("lab.yaml", "no cluster; expected tcp://HOST:8786"),
        ("other.json", "no address of a scheduler"),
        ("no.json", "no such file"),
    ):
        study = study_of(tmp_path, ["walk"], cluster=str(tmp_path / described))
        with pytest.raises(InputError, match=words), cluster.cluster_places(study, tmp_path, print):
            pass


def test_a_scheduler_that_cannot_be_reached(tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(cluster, "CONNECT_S", 0.5)
    study = study_of(tmp_path, ["walk"], cluster="tcp://127.0.0.1:1")
    words = r"--cluster tcp://127\.0\.0\.1:1: cannot be reached.*start one with `dask scheduler`"
    with pytest.raises(InputError, match=words), cluster.cluster_places(study, tmp_path, print):
        pass
    assert capfd.readouterr().err == ""
