"""`bayes-body learn kinematic-potentials`: learn densities of the joints of a loose-limbed body, for the potential `kinematic`."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bayes_body.base.errors import input_error
from bayes_body.cli.learned_files import BODY, Out, Overwrite, Source, check_out, command_line, motion_files, portable, write_record
from bayes_body.cli.terminal import say, show

if TYPE_CHECKING:
    from bayes_body.model.body.schema import BodySchema
    from bayes_body.model.potentials.joint_mixture import JointMixtures
    from bayes_body.workshop.learning.kinematic_potentials import HeldOut, JointPoses


def kinematic_potentials(
    motions: Annotated[list[Path], typer.Argument(help="Captured motions, or folders of them, one folder a person.")],
    out: Out,
    body: str = typer.Option(BODY, "--body", help="The body whose joints are learned: its name or the path of your own .toml file."),
    components: int = typer.Option(4, "--components", min=1, help="Components of the mixture of each joint."),
    floor_mm: float = typer.Option(10.0, "--floor-mm", help="Smallest standard deviation of a joint's position, millimetres."),
    floor_deg: float = typer.Option(2.0, "--floor-deg", help="Smallest standard deviation of a joint's rotation, degrees."),
    frames: int = typer.Option(60, "--frames", min=2, help="Frames that are used of each motion."),
    test: list[Path] = typer.Option([], "--held-out", help="Motions of other people, or a folder of them, for the table; may be repeated."),
    source: Source = "",
    overwrite: Overwrite = False,
) -> None:
    """Learn a Gaussian mixture of the pose of each part relative to its parent, and compare it with one Gaussian."""
    from bayes_body.base.config import configure

    check_out(out, overwrite)
    for option, value in (("--floor-mm", floor_mm), ("--floor-deg", floor_deg)):
        if not (math.isfinite(value) and value > 0):
            raise input_error(option, f"{value:g}", "a finite number above 0", "correct it")
    configure()
    from bayes_body.model.definition import load_body
    from bayes_body.model.potentials.joint_mixture import save_joint_mixtures
    from bayes_body.workshop.learning.kinematic_potentials import Floors, held_out, joints_of, learn_joints

    schema = load_body(body)
    joints_of(body, schema)
    floors = Floors(floor_mm / 1000, math.radians(floor_deg))
    train = _poses(motions, body, schema, frames)
    joints, single = (learn_joints(train, body, schema, count, floors) for count in (components, 1))
    save_joint_mixtures(joints, out)
    compared = _poses(test, body, schema, frames) if test else train
    results = held_out(joints, compared), held_out(single, compared)
    options = {"--components": (components, 4), "--floor-mm": (floor_mm, 10.0), "--floor-deg": (floor_deg, 2.0), "--frames": (frames, 60)}
    words = [word for option, (value, default) in options.items() if value != default for word in (option, f"{value}")]
    words += [word for path in test for word in ("--held-out", portable(path))]
    command = command_line("kinematic-potentials", map(portable, motions), out, body, words)
    _record(joints, out, source, command, train, compared if test else [], results)
    _show(joints, f"{len(compared)} motions" + (" held out" if test else ", the same that were learned from"), *results)
    say(f"{out}: {len(joints.parts)} joints, {components} components each, from {len(train)} motions of {_people(train)} people.")


def _poses(paths: Sequence[Path], body: str, schema: "BodySchema", frames: int) -> "list[JointPoses]":
    from bayes_body.base.progress import watched
    from bayes_body.recording.readers.mocap import read_motion
    from bayes_body.workshop.learning.kinematic_potentials import joint_poses

    files = [file for path in paths for file in motion_files(path)]
    motions = [read_motion(file) for file in files]
    indices = watched("retargeting")(range(len(files)))
    return [joint_poses(files[k].stem, files[k].resolve().parent.name, motions[k], body, schema, frames) for k in indices]


def _people(motions: "Sequence[JointPoses]") -> int:
    return len({motion.subject for motion in motions})


def _show(joints: "JointMixtures", subject: str, mixture: "HeldOut", single: "HeldOut") -> None:
    from rich.table import Table

    table = Table("joint", "mixture", "one Gaussian", "difference", "by person", box=None, pad_edge=False)
    for column in table.columns[1:]:
        column.justify = "right"
    rows = [(part, mixture.values[:, j], single.values[:, j]) for j, part in enumerate(joints.parts)]
    for part, ours, theirs in [*rows, ("all", mixture.values.sum(axis=1), single.values.sum(axis=1))]:
        gain = ours - theirs
        table.add_row(part, f"{ours.mean():.2f}", f"{theirs.mean():.2f}", f"{gain.mean():.2f}", f"{gain.min():.2f} to {gain.max():.2f}")
    show(f"log-density of {subject}, nats a frame, mean of {len(mixture.subjects)} people", table)


def _record(
    joints: "JointMixtures",
    out: Path,
    source: str,
    command: str,
    train: "Sequence[JointPoses]",
    test: "Sequence[JointPoses]",
    results: "tuple[HeldOut, HeldOut]",
) -> None:
    entries = {
        "title": "Poses of the parts of a loose-limbed body relative to their parents",
        "source": source,
        "body": joints.body,
        "parts": list(joints.parts),
        "motions": [motion.name for motion in train],
        "command": command,
        "frames": sum(len(motion.poses) for motion in train),
        "components": joints.weight.shape[1],
    }
    if test:
        mixture, single = (round(float(result.values.sum(axis=1).mean()), 2) for result in results)
        entries |= {"held_out": [motion.name for motion in test], "held_out_nats": mixture, "held_out_nats_of_one_gaussian": single}
    write_record(out, "Arrays: for each joint the means, covariances and weights of a Gaussian mixture of relative poses.", entries)
