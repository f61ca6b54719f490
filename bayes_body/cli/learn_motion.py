"""`bayes-body learn` a motion prior from captured motion.

- `walking-cycle`: a walker's stride in points; simulated people walk with it.
- `walking-angles`: the stride of several people in joint angles, for the motion prior `walking_cycle`.
- `activity-hmm`: an activity as a hidden Markov model, for the motion prior `activity_hmm`.
"""

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from bayes_body.cli.learned_files import BODY, Out, Overwrite, Source, check_out, command_line, motion_files, portable, write_record
from bayes_body.cli.terminal import say

if TYPE_CHECKING:
    from bayes_body.recording.readers.mocap.motion import Motion
    from bayes_body.workshop.learning.activity_hmm import LearnedActivity, LearnOptions
    from bayes_body.workshop.learning.activity_motions import Captured
    from bayes_body.workshop.learning.walking_angles import LearnedAngles

Body = Annotated[str, typer.Option("--body", help="The body whose joint angles are learned: its name or the path of your own .toml file.")]
WALK = "walk"
LABELLED = re.compile(r"([A-Za-z]\w*)=(.+)")


def walking_cycle(
    walks: Annotated[
        list[Path],
        typer.Argument(help="Captured walks of one person straight ahead, or a folder of them; motions in which the person runs are left out."),
    ],
    out: Out,
    source: Source = "",
    overwrite: Overwrite = False,
) -> None:
    """Learn a walker's mean stride and the main variations between strides; simulated people walk with them."""
    from bayes_body.recording.readers.mocap import landmarks, read_motion
    from bayes_body.workshop.learning.gait import learn, save_cycle

    check_out(out, overwrite)
    files = [file for path in walks for file in motion_files(path)]
    motions = [(file.stem, read_motion(file)) for file in files]
    model = learn([(name, landmarks(motion), motion.fps) for name, motion in motions])
    for sentence in model.left_out:
        say(sentence)
    save_cycle(model.cycle, out)
    used = [file.stem for file in files if not any(sentence.startswith(f"{file.stem}:") for sentence in model.left_out)]
    cycle, (duration, length) = model.cycle, model.cycle.pace
    entries = {
        "title": "Mean stride of one walker, and the main modes of variation between strides",
        "source": source,
        "motions": used,
        "command": command_line("walking-cycle", map(portable, walks), out),
        "strides": model.strides,
        "modes": len(cycle.modes),
        "explained": round(model.explained, 3),
        "height_m": round(cycle.height_m, 3),
        "stride_s": round(math.exp(duration), 3),
        "stride_m": round(math.exp(length) * cycle.height_m, 3),
    }
    write_record(out, "Arrays: mean and modes (Fourier coefficients of landmarks relative to the pelvis, in heights), pace and segments.", entries)
    say(f"{out}: {model.strides} strides of {', '.join(used)}, {len(cycle.modes)} modes explain {100 * model.explained:.0f} % of the variance.")


def walking_angles(
    walks: Annotated[
        list[Path],
        typer.Argument(help="Captured straight walks, or folders of them, one folder a person; motions in which the person runs are left out."),
    ],
    out: Out,
    body: Body = BODY,
    source: Source = "",
    overwrite: Overwrite = False,
) -> None:
    """Learn the mean stride of several people as joint angles, and the main variations between strides and people."""
    from bayes_body.base.config import configure

    check_out(out, overwrite)
    configure()
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
    _record_angles(learned, out, source, command_line("walking-angles", map(portable, walks), out, body))
    people = len({file.resolve().parent for file, _ in usable})
    share = 100 * learned.cycle.explained
    say(
        f"{out}: {learned.strides} strides of {people} people in {len(usable)} walks, "
        f"{len(learned.cycle.modes)} modes explain {share:.0f} % of the variance."
    )


def _record_angles(learned: "LearnedAngles", out: Path, source: str, command: str) -> None:
    cycle, (duration, length) = learned.cycle, learned.cycle.pace
    entries = {
        "title": "Mean stride of several walkers in joint angles, and the main modes of variation between strides and people",
        "source": source,
        "body": cycle.body,
        "motions": list(learned.walks),
        "command": command,
        "strides": learned.strides,
        "modes": len(cycle.modes),
        "explained": round(cycle.explained, 3),
        "residual_deg": round(math.degrees(math.sqrt(sum(sd**2 for sd in cycle.residual) / len(cycle.residual))), 2),
        "stride_in_root_of_leg_over_g": round(math.exp(duration), 3),
        "stride_in_legs": round(math.exp(length), 3),
    }
    write_record(out, "Arrays: mean and modes (Fourier coefficients of joint angles), pace, residual (its standard deviations).", entries)


class LabelledPath(NamedTuple):
    """A file or folder of motion, and the label of its activity, or None without one."""

    label: str | None
    path: Path

    def portable(self) -> str:
        """Return it as the command line wrote it, without the part that is specific to this machine."""
        return portable(self.path) if self.label is None else f"{self.label}={portable(self.path)}"


def activity_hmm(
    mocap: Annotated[
        list[str],
        typer.Argument(
            help="Captured motions, or folders of them, one folder a person. Without a label they are walks, and runs are left out; "
            "run=02_03.amc is another activity."
        ),
    ],
    out: Out,
    body: Body = BODY,
    components: int = typer.Option(4, "--components", min=1, help="Number of features: principal components of the joint angles."),
    states: int = typer.Option(30, "--states", min=1, help="Number of states, of all activities together."),
    fps: float = typer.Option(60.0, "--fps", min=1, help="Frames per second; that of the recordings to be tracked."),
    restarts: int = typer.Option(4, "--restarts", min=1, help="Number of starts; the best on motion held out is used."),
    switch_per_s: float = typer.Option(0.2, "--switch-per-s", min=0, max=1, help="Probability of changing to another activity, per second."),
    learn_initial: bool = typer.Option(False, "--learn-initial", help="Learn how probable the states are at first; otherwise all are alike."),
    seed: int = typer.Option(0, "--seed", min=0, help="Seed of the first start."),
    source: Source = "",
    overwrite: Overwrite = False,
) -> None:
    """Learn a linear subspace of the joint angles of an activity, and a hidden Markov model in it."""
    from bayes_body.base.config import configure

    check_out(out, overwrite)
    labelled_paths = [labelled(word) for word in mocap]
    configure()
    from bayes_body.base.progress import watched
    from bayes_body.model.definition import load_body
    from bayes_body.model.dynamics.activity import save_activity
    from bayes_body.recording.readers.mocap import read_motion
    from bayes_body.workshop.learning.activity_hmm import LearnOptions, learn_activity
    from bayes_body.workshop.learning.activity_motions import captured, check_rate

    schema, options = load_body(body), LearnOptions(components, states, fps, restarts, seed, switch_per_s, learn_initial)
    files = [(labelled_path.label, file) for labelled_path in labelled_paths for file in motion_files(labelled_path.path)]
    motions = [(label, file, read_motion(file)) for label, file in files]
    for _, file, motion in motions:
        check_rate(str(file), motion.fps, fps)
    usable = _usable(motions)
    recordings = (usable[k] for k in watched("retargeting")(range(len(usable))))
    tracks = [captured(file.stem, file.resolve().parent.name, label or WALK, motion, body, schema, fps) for label, file, motion in recordings]
    learned = learn_activity(tracks, body, schema, options, watched("learning"))
    save_activity(learned.activity, out)
    words = [labelled_path.portable() for labelled_path in labelled_paths]
    _record_activity(learned, tracks, options, out, source, command_line("activity-hmm", words, out, body, _option_words(options)))
    for sentence in learned.sentences:
        say(sentence)
    say(
        f"{out}: {len(learned.activity.labels)} states from {sum(len(track.dofs) for track in tracks)} frames of {len(tracks)} motions of "
        f"{len(learned.activity.subjects)} people; {components} features keep {100 * learned.activity.kept:.0f} % of the variance; "
        f"log-likelihood {learned.held_out:.2f} nats a frame held out, {learned.training:.2f} in training."
    )


def labelled(word: str) -> LabelledPath:
    """Return the label and the path of an argument such as `run=02/02_03.amc`."""
    match = LABELLED.fullmatch(word)
    return LabelledPath(match[1], Path(match[2])) if match and not Path(word).exists() else LabelledPath(None, Path(word))


def _usable(motions: "Sequence[tuple[str | None, Path, Motion]]") -> "list[tuple[str | None, Path, Motion]]":
    """Return the motions without those that are left out, and say why. Motions with a label are all used."""
    from bayes_body.workshop.learning.activity_motions import no_walk

    faults = [no_walk(file.stem, motion) if label is None else None for label, file, motion in motions]
    for sentence in filter(None, faults):
        say(sentence)
    return [motion for motion, fault in zip(motions, faults, strict=True) if not fault]


def _option_words(options: "LearnOptions") -> list[str]:
    """Return the words of the options that are not the default ones."""
    from bayes_body.workshop.learning.activity_hmm import LearnOptions

    words = []
    for name, value in options._asdict().items():
        if value != LearnOptions._field_defaults[name]:
            option = f"--{name.replace('_', '-')}"
            words += [option] if value is True else [option, f"{value:.15g}"]
    return words


def _record_activity(learned: "LearnedActivity", tracks: "Sequence[Captured]", options: "LearnOptions", out: Path, source: str, command: str) -> None:
    activity = learned.activity
    activities = list(dict.fromkeys(activity.labels))
    entries = {
        "title": f"Joint angles of an activity ({', '.join(activities)}) as a hidden Markov model",
        "source": source,
        "body": activity.body,
        "motions": [track.name for track in tracks],
        "command": command,
        "fps": options.fps,
        "frames": sum(len(track.dofs) for track in tracks),
        "activities": activities,
        "states": [activity.labels.count(label) for label in activities],
        "components": options.components,
        "kept": round(activity.kept, 3),
        "log_likelihood_held_out": round(learned.held_out, 2),
        "log_likelihood_training": round(learned.training, 2),
    }
    write_record(out, "Arrays: see `bayes_body.model.dynamics.activity.Activity`. Log-likelihoods are in nats per frame.", entries)
