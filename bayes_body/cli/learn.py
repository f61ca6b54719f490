"""`bayes-body learn`: learn small arrays from captured motion, with a record of their source and command; learn the scale of a likelihood."""

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from bayes_body.cli.activity_hmm import activity_hmm
from bayes_body.cli.kinematic_potentials import kinematic_potentials
from bayes_body.cli.learned_files import check_out, motion_files, portable
from bayes_body.cli.likelihood_scale import likelihood_scale
from bayes_body.cli.terminal import say
from bayes_body.cli.walking_angles import walking_angles

if TYPE_CHECKING:
    from bayes_body.workshop.learning.gait import Learned

app = typer.Typer(help="Learn from captured motion, or from recordings with their truth.", no_args_is_help=True)
app.command("likelihood-scale", short_help="The precision at which 90 % intervals hold.")(likelihood_scale)
app.command("walking-angles", short_help="The mean stride of several people.")(walking_angles)
app.command("kinematic-potentials", short_help="The joints of a loose-limbed body.")(kinematic_potentials)
app.command("activity-hmm", short_help="A hidden Markov model of an activity.")(activity_hmm)


@app.command("walking-cycle", short_help="A walker's stride and its main changes.")
def walking_cycle(
    walks: list[Path] = typer.Argument(
        help="Captured walks of one person straight ahead, or a folder of them; motions in which the person runs are left out."
    ),
    out: Path = typer.Option(..., "--out", help="The .npz to write; a .toml beside it records its source."),
    source: str = typer.Option("", "--source", help="The source of the data, for the .toml."),
    overwrite: bool = typer.Option(False, "--overwrite", help="Replace existing files."),
) -> None:
    """Learn a walker's mean stride and the main variations between strides; simulated people walk with them."""
    from bayes_body.base.files.atomic import write_text
    from bayes_body.recording.readers.mocap import landmarks, read_motion
    from bayes_body.workshop.learning.gait import learn, save_cycle

    table = out.with_suffix(".toml")
    check_out(out, table, overwrite)
    files = [file for path in walks for file in motion_files(path)]
    motions = [(file.stem, read_motion(file)) for file in files]
    model = learn([(name, landmarks(motion), motion.fps) for name, motion in motions])
    for sentence in model.left_out:
        say(sentence)
    save_cycle(model.cycle, out)
    used = [file.stem for file in files if not any(sentence.startswith(f"{file.stem}:") for sentence in model.left_out)]
    write_text(table, _source_text(model, source, used, [*map(portable, walks), "--out", portable(out)]))
    say(f"{out}: {model.strides} strides of {', '.join(used)}, {len(model.cycle.modes)} modes explain {100 * model.explained:.0f} % of the variance.")


def _source_text(model: "Learned", source: str, used: list[str], words: list[str]) -> str:
    """Return the text of the file beside the arrays, with their source and the command that makes them."""
    import math

    import tomlkit

    cycle, (duration, length) = model.cycle, model.cycle.pace
    document = tomlkit.document()
    document.add(tomlkit.comment("Arrays: mean and modes (Fourier coefficients of landmarks relative to the pelvis, in heights), pace and segments."))
    document["title"] = "Mean stride of one walker, and the main modes of variation between strides"
    document["source"] = source
    document["motions"] = used
    document["command"] = " ".join(["bayes-body learn walking-cycle", *words])
    document["strides"] = model.strides
    document["modes"] = len(cycle.modes)
    document["explained"] = round(model.explained, 3)
    document["height_m"] = round(cycle.height_m, 3)
    document["stride_s"] = round(math.exp(duration), 3)
    document["stride_m"] = round(math.exp(length) * cycle.height_m, 3)
    return tomlkit.dumps(document)
