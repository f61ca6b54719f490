"""`bayes-body learn walking-angles`: learn a walking cycle in the joint angles of a body, for the motion prior `walking_cycle`."""

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from bayes_body.cli.learned_files import check_out, motion_files, portable
from bayes_body.cli.terminal import say

if TYPE_CHECKING:
    from bayes_body.workshop.learning.walking_angles import LearnedAngles


def walking_angles(
    walks: list[Path] = typer.Argument(
        help="Captured straight walks, or folders of them, one folder a person; motions in which the person runs are left out."
    ),
    out: Path = typer.Option(..., "--out", help="The .npz to write; a .toml beside it records its source."),
    body: str = typer.Option("person_31", "--body", help="The body whose joint angles are learned: its name or the path of your own .toml file."),
    source: str = typer.Option("", "--source", help="The source of the data, for the .toml."),
    overwrite: bool = typer.Option(False, "--overwrite", help="Replace existing files."),
) -> None:
    """Learn the mean stride of several people as joint angles, and the main variations between strides and people."""
    from bayes_body.base.config import configure

    table = out.with_suffix(".toml")
    check_out(out, table, overwrite)
    configure()
    from bayes_body.base.files.atomic import write_text
    from bayes_body.base.progress import watched
    from bayes_body.model.definition import load_body
    from bayes_body.model.dynamics.angle_cycle import save_angle_cycle
    from bayes_body.recording.readers.mocap import read_motion
    from bayes_body.workshop.learning.walking_angles import angles_of_walk, learn_angles, unusable

    schema = load_body(body)
    files = [file for path in walks for file in motion_files(path)]
    motions = [(file, read_motion(file)) for file in files]
    faults = {file: unusable(file.stem, motion) for file, motion in motions}
    for sentence in filter(None, faults.values()):
        say(sentence)
    usable = [(file, motion) for file, motion in motions if not faults[file]]
    indices = watched("retargeting")(range(len(usable)))
    learned = learn_angles(
        [angles_of_walk(file.stem, file.resolve().parent.name, motion, body, schema) for file, motion in (usable[k] for k in indices)], body, schema
    )
    save_angle_cycle(learned.cycle, out)
    body_words = [] if body == "person_31" else ["--body", body]
    write_text(table, _source_text(learned, source, [*map(portable, walks), *body_words, "--out", portable(out)]))
    people = len({file.resolve().parent for file, _ in usable})
    share = 100 * learned.cycle.explained
    say(
        f"{out}: {learned.strides} strides of {people} people in {len(usable)} walks, "
        f"{len(learned.cycle.modes)} modes explain {share:.0f} % of the variance."
    )


def _source_text(learned: "LearnedAngles", source: str, words: list[str]) -> str:
    """Return the text of the file beside the arrays, with their source and the command that makes them."""
    import math

    import tomlkit

    cycle, (duration, length) = learned.cycle, learned.cycle.pace
    document = tomlkit.document()
    document.add(tomlkit.comment("Arrays: mean and modes (Fourier coefficients of joint angles), pace, residual (its standard deviations)."))
    document["title"] = "Mean stride of several walkers in joint angles, and the main modes of variation between strides and people"
    document["source"] = source
    document["body"] = cycle.body
    document["motions"] = list(learned.walks)
    document["command"] = " ".join(["bayes-body learn walking-angles", *words])
    document["strides"] = learned.strides
    document["modes"] = len(cycle.modes)
    document["explained"] = round(cycle.explained, 3)
    document["residual_deg"] = round(math.degrees(math.sqrt(sum(sd**2 for sd in cycle.residual) / len(cycle.residual))), 2)
    document["stride_in_root_of_leg_over_g"] = round(math.exp(duration), 3)
    document["stride_in_legs"] = round(math.exp(length), 3)
    return tomlkit.dumps(document)
