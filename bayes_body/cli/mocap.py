"""`bayes-body mocap`: convert a captured motion to the joint angles of a body."""

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from bayes_body.base.errors import input_error
from bayes_body.cli.terminal import say, show

if TYPE_CHECKING:
    import numpy as np

    from bayes_body.initial.retarget import Retargeted


def mocap(
    file: Path = typer.Argument(help="Motion capture: .amc, .bvh, .c3d or .trc."),
    out: Path = typer.Option(..., "--out", help="The .npz to write: markers (a session's truth), angles, lengths."),
    body: str = typer.Option("deutscher_31", "--body", help="The body whose joint angles are computed: its name or the path of your own .toml file."),
    skeleton: Path | None = typer.Option(None, "--skeleton", help="The .asf of an .amc; the one beside it by default."),
    unit: str | None = typer.Option(None, "--unit", help="m, cm, mm, in, ft or cmu; by default the file's unit, or its format's usual one."),
    up: str | None = typer.Option(None, "--up", help="The file's axis that points up, if it cannot be detected: x, y, z, -x, -y or -z."),
    fps: float | None = typer.Option(None, "--fps", help="Frames a second of the result; the file's own by default."),
    height: float | None = typer.Option(
        None, "--height", help="The person's height, metres: the fit starts from its lengths, or with --keep-lengths keeps them."
    ),
    keep_lengths: bool = typer.Option(False, "--keep-lengths", help="Keep the body's lengths; by default they are fitted to the person."),
    overwrite: bool = typer.Option(False, "--overwrite", help="Replace an existing file."),
) -> None:
    """Map a captured motion to a body's joint angles, exactly if the skeletons agree, and show the distances of its markers."""
    from bayes_body.base.config import configure

    _check(out, height, overwrite)
    configure()
    from bayes_body.base.progress import waiting
    from bayes_body.initial.retarget import retarget
    from bayes_body.model.body.build import Shape, build_body
    from bayes_body.model.definition import load_body
    from bayes_body.recording.readers.mocap import landmarks, read_motion, resample

    schema = load_body(body)
    motion = read_motion(file, skeleton=skeleton, unit=unit, up=up)
    motion = motion if fps is None else resample(motion, fps)
    with waiting(f"fitting {len(motion.positions_m)} frames"):
        fit = retarget(build_body(body, schema, Shape(height)), motion, fit_lengths=not keep_lengths, schema=schema)
    _write(out, fit, landmarks(motion), motion.fps)
    _tell(fit, motion.fps)
    say(f"{out}: {len(fit.angles)} frames.")


def _check(out: Path, height: float | None, overwrite: bool) -> None:
    if out.suffix != ".npz":
        raise input_error("--out", str(out), "a file that ends in .npz", "give such a name")
    if out.exists() and not overwrite:
        raise input_error(out, "already exists", "a file that does not exist yet", "name another, or give --overwrite")
    if height is not None and not 0.5 <= height <= 2.8:
        raise input_error("--height", f"{height:g}", "metres between 0.5 and 2.8", "correct it")


def _write(out: Path, fit: "Retargeted", points: "dict[str, np.ndarray]", fps: float) -> None:
    """Write the motion in the form that `recording.truth.read_truth` reads, and the joint angles, lengths and residuals."""
    import numpy as np

    from bayes_body.base.files.atomic import replacing
    from bayes_body.recording.evidence.markers import MARKERS

    with replacing(out) as partial, partial.open("wb") as file:
        np.savez_compressed(
            file,
            markers=np.stack([points[name] for name in MARKERS], axis=1),
            names=np.array(MARKERS),
            angles=fit.angles,
            dof_names=np.array(fit.body.dof_names),
            lengths_m=np.array(list(fit.lengths_m.values())),
            length_names=np.array(list(fit.lengths_m), dtype=str),
            residual_m=fit.residual_m,
            residual_names=np.array(fit.marker_names),
            body=fit.body.name,
            exact=fit.exact,
            fps=fps,
        )


def _tell(fit: "Retargeted", fps: float) -> None:
    from rich.table import Table

    way = "the motion's own angles: its skeleton is the body's" if fit.exact else "fitted to the motion's points"
    say(f"{len(fit.body.dof_names)} dofs of {fit.body.name}, {len(fit.angles)} frames at {fps:g} a second, {way}")
    table = Table("marker", "mean mm", "95 % mm", "max mm", box=None, pad_edge=False)
    for column in table.columns[1:]:
        column.justify = "right"
    for name in (*fit.marker_names, None):
        residual = fit.residual(name)
        table.add_row("all" if name is None else name, *(f"{value:.1f}" for value in residual))
    show(table)
    if fit.lengths_m:
        say("lengths: " + ", ".join(f"{name} {length:.3f}" for name, length in fit.lengths_m.items()) + " m")
    for remark in fit.remarks:
        say(remark)
