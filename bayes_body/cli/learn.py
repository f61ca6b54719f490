"""`bayes-body learn`: small arrays from captured motion, with their source and the command that learns them again; constants of likelihoods."""

import os
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from bayes_body.cli.edge_statistics import edge_statistics
from bayes_body.cli.likelihood_scale import likelihood_scale
from bayes_body.errors import input_error

if TYPE_CHECKING:
    from bayes_body.learning.cycle import Learned

app = typer.Typer(help="Learn from captured motion, or from recordings with their truth.", no_args_is_help=True)
app.command("likelihood-scale")(likelihood_scale)
app.command("edge-statistics")(edge_statistics)
ENDINGS = (".amc", ".bvh", ".c3d", ".trc")


@app.command("walking-cycle")
def walking_cycle(
    walks: list[Path] = typer.Argument(help="Captured walks of one person straight ahead, or a folder of them; runs are left out."),
    out: Path = typer.Option(..., "--out", help="The .npz to write; a .toml beside it says where it comes from."),
    source: str = typer.Option("", "--source", help="Whose data it is, for the .toml."),
    overwrite: bool = typer.Option(False, "--overwrite", help="Replace files that are there already."),
) -> None:
    """Learn the mean stride of a walker and the modes in which strides differ, with which a simulated person walks."""
    from bayes_body.files.atomic import write_text
    from bayes_body.learning.cycle import learn, save_cycle
    from bayes_body.recording.mocap import landmarks, read_motion

    table = out.with_suffix(".toml")
    _check(out, table, overwrite)
    files = [file for path in walks for file in _files(path)]
    motions = [(file.stem, read_motion(file)) for file in files]
    found = learn([(name, landmarks(motion), motion.fps) for name, motion in motions])
    for sentence in found.left_out:
        typer.echo(sentence)
    save_cycle(found.cycle, out)
    used = [file.stem for file in files if not any(sentence.startswith(f"{file.stem}:") for sentence in found.left_out)]
    write_text(table, _told(found, source, used, [*map(_named, walks), "--out", _named(out)]))
    typer.echo(f"{out}: {found.strides} strides of {', '.join(used)}, {len(found.cycle.modes)} modes for {100 * found.explained:.0f} %.")


def _check(out: Path, table: Path, overwrite: bool) -> None:
    if out.suffix != ".npz":
        raise input_error("--out", str(out), "a file that ends in .npz", "name one")
    for path in (out, table):
        if path.exists() and not overwrite:
            raise input_error(path, "is there already", "a file that is not", "name another, or give --overwrite")


def _files(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    found = sorted(file for file in path.iterdir() if file.suffix.lower() in ENDINGS)
    if not found:
        raise input_error(path, "no captured motion in it", f"files that end in {', '.join(ENDINGS)}", "name another folder")
    return found


def _named(path: Path) -> str:
    """The path without what is this machine's own."""
    root = os.environ.get("BAYES_BODY_DATA")
    if root and path.resolve().is_relative_to(Path(root).resolve()):
        return f"$BAYES_BODY_DATA/{path.resolve().relative_to(Path(root).resolve())}"
    return path.name


def _told(found: "Learned", source: str, used: list[str], words: list[str]) -> str:
    """The file beside the arrays: where they come from, and how to make them again."""
    import math

    import tomlkit

    cycle, (duration, length) = found.cycle, found.cycle.pace
    document = tomlkit.document()
    document.add(tomlkit.comment("Arrays: mean and modes (Fourier terms of landmarks against the pelvis, in heights), pace and segments."))
    document["title"] = "The mean stride of one walker and the modes in which strides differ"
    document["source"] = source
    document["motions"] = used
    document["command"] = " ".join(["bayes-body learn walking-cycle", *words])
    document["strides"] = found.strides
    document["modes"] = len(cycle.modes)
    document["explained"] = round(found.explained, 3)
    document["height_m"] = round(cycle.height_m, 3)
    document["stride_s"] = round(math.exp(duration), 3)
    document["stride_m"] = round(math.exp(length) * cycle.height_m, 3)
    return tomlkit.dumps(document)
