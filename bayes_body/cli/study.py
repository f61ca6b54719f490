"""`bayes-body study`: track many sessions as a study's file says."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from bayes_body.base.errors import input_error
from bayes_body.cli.terminal import say

if TYPE_CHECKING:
    from bayes_body.runs.study.study_file import StudyFile

CLUSTER_HELP = (
    "Where the units run: tcp://HOST:8786 or a scheduler's file for a running Dask cluster, or a .toml that describes SLURM, PBS, LSF, SGE, HTCondor "
    "or machines by ssh; by default this machine."
)


def study(
    file: Path = typer.Argument(help="A study's file: sessions, models and kernels, runs, what to do afterwards."),
    out: Path | None = typer.Option(None, "--out", help="Folder of the study; by default that of the file's key `out`, or the file's own name."),
    cluster: str | None = typer.Option(None, "--cluster", help=CLUSTER_HELP),
    dry_run: bool = typer.Option(False, "--dry-run", help="Print the units, and the job script of a cluster; compute nothing."),
) -> None:
    """Track many sessions: runs/SESSION/RUN/ as `track` writes it, index.html, study.csv. The same command again continues."""
    from bayes_body.runs.study.study_file import NAME, read_study_file

    described = read_study_file(file)
    folder = out or (Path(described.out) if described.out else file.parent if file.name == NAME else file.with_suffix(""))
    start(described, folder, cluster, dry_run)


def track_several(sessions: list[Path], out: Path | None, table: dict[str, Any], cluster: str | None) -> None:
    """Compute the study of `bayes-body track` with several sessions.

    Args:
        sessions: their folders.
        out: the folder of the study.
        table: what a study's file would say, without its sessions.
        cluster: where it runs.

    Raises:
        InputError: no folder for the study, a folder that has no session, or options that are wrong.
    """
    from bayes_body.base.toml.read import validate
    from bayes_body.runs.study.study_file import StudyFile, absolute
    from bayes_body.runs.study.units import SESSION_FILE

    if out is None:
        raise input_error("--out", "missing", "a folder for the study of several sessions", "add it, such as --out runs")
    folders = [folder.parent if folder.name == SESSION_FILE else folder for folder in sessions]
    for folder in folders:
        if not (folder / SESSION_FILE).is_file():
            problem = f"no {SESSION_FILE} in it" if folder.is_dir() else "no such folder" if not folder.exists() else "a file"
            raise input_error(folder, problem, "the folder of a session", "leave it out, or make a session with `bayes-body import`")
    table = {**table, "sessions": [str(folder) for folder in folders]}
    start(absolute(validate(StudyFile, table, "bayes-body track"), Path.cwd()), out, cluster, dry_run=False)


def start(study: "StudyFile", out: Path, cluster: str | None, dry_run: bool) -> None:
    """Compute a study. End with status 1 if a unit is not done.

    Raises:
        InputError: the study cannot begin.
    """
    if cluster is not None:
        study = study.model_copy(update={"cluster": cluster if "://" in cluster else str(Path(cluster).absolute())})
    if out.exists() and not out.is_dir():
        raise input_error(out, "a file", "a folder for the study", "name another with --out")
    if (out / "run.toml").exists():
        raise input_error(out, "holds a single run", "a folder for the study", "name another with --out")
    if dry_run:
        from bayes_body.runs.study.study import preview

        preview(study, out, say)
        return
    from bayes_body.runs.study.study import run_study

    if not run_study(study, out, say, bar=True):
        raise typer.Exit(1)
