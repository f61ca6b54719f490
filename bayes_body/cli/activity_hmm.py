"""`bayes-body learn activity-hmm`: learn an activity as a hidden Markov model, for the motion prior `activity_hmm`."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import typer

from bayes_body.cli.learned_files import check_out, motion_files, portable
from bayes_body.cli.terminal import say

if TYPE_CHECKING:
    from bayes_body.recording.readers.mocap.motion import Motion
    from bayes_body.workshop.learning.activity_hmm import LearnedActivity, LearnOptions
    from bayes_body.workshop.learning.activity_motions import Captured

WALK = "walk"
LABELLED = re.compile(r"([A-Za-z]\w*)=(.+)")


class Given(NamedTuple):
    """A file or folder of motion, and its label, or None if none was given."""

    label: str | None
    path: Path

    def told(self) -> str:
        """Return it as the command line gave it, without the part that is specific to this machine."""
        return portable(self.path) if self.label is None else f"{self.label}={portable(self.path)}"


def activity_hmm(
    mocap: list[str] = typer.Argument(
        help="Captured motions, or folders of them, one folder a person. Without a label they are walks, and runs are left out; run=02_03.amc is "
        "another activity."
    ),
    out: Path = typer.Option(..., "--out", help="The .npz to write; a .toml beside it records its source."),
    body: str = typer.Option("person_31", "--body", help="The body whose joint angles are learned: its name or the path of your own .toml file."),
    components: int = typer.Option(4, "--components", min=1, help="Number of features: principal components of the joint angles."),
    states: int = typer.Option(30, "--states", min=1, help="Number of states, of all activities together."),
    fps: float = typer.Option(60.0, "--fps", min=1, help="Frames per second; that of the recordings to be tracked."),
    restarts: int = typer.Option(4, "--restarts", min=1, help="Number of starts; the best on motion held out is used."),
    switch_per_s: float = typer.Option(0.2, "--switch-per-s", min=0, max=1, help="Probability of changing to another activity, per second."),
    learn_initial: bool = typer.Option(False, "--learn-initial", help="Learn how probable the states are at first; otherwise all are alike."),
    seed: int = typer.Option(0, "--seed", min=0, help="Seed of the first start."),
    source: str = typer.Option("", "--source", help="The source of the data, for the .toml."),
    overwrite: bool = typer.Option(False, "--overwrite", help="Replace existing files."),
) -> None:
    """Learn a linear subspace of the joint angles of an activity, and a hidden Markov model in it."""
    from bayes_body.base.config import configure

    table = out.with_suffix(".toml")
    check_out(out, table, overwrite)
    labelled_paths = [labelled(word) for word in mocap]
    configure()
    from bayes_body.base.files.atomic import write_text
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
    words = [*(labelled_path.told() for labelled_path in labelled_paths), *_options(body, options), "--out", portable(out)]
    write_text(table, _source_text(learned, tracks, options, source, words))
    for sentence in learned.sentences:
        say(sentence)
    say(
        f"{out}: {len(learned.activity.labels)} states from {sum(len(track.dofs) for track in tracks)} frames of {len(tracks)} motions of "
        f"{len(learned.activity.subjects)} people; {components} features keep {100 * learned.activity.kept:.0f} % of the variance; "
        f"log-likelihood {learned.held_out:.2f} nats a frame held out, {learned.training:.2f} in training."
    )


def labelled(word: str) -> Given:
    """Return the label and the path of an argument such as `run=02/02_03.amc`."""
    match = LABELLED.fullmatch(word)
    return Given(match[1], Path(match[2])) if match and not Path(word).exists() else Given(None, Path(word))


def _usable(motions: "Sequence[tuple[str | None, Path, Motion]]") -> "list[tuple[str | None, Path, Motion]]":
    """Return the motions without those that are left out, and say why. Motions with a label are all used."""
    from bayes_body.workshop.learning.activity_motions import no_walk

    faults = [no_walk(file.stem, motion) if label is None else None for label, file, motion in motions]
    for sentence in filter(None, faults):
        say(sentence)
    return [motion for motion, fault in zip(motions, faults, strict=True) if not fault]


def _options(body: str, options: "LearnOptions") -> list[str]:
    """Return the words of the options that are not the default ones."""
    from bayes_body.workshop.learning.activity_hmm import LearnOptions

    words = [] if body == "person_31" else ["--body", body]
    for name, value in options._asdict().items():
        if value != LearnOptions._field_defaults[name]:
            option = f"--{name.replace('_', '-')}"
            words += [option] if value is True else [option, f"{value:g}"]
    return words


def _source_text(learned: "LearnedActivity", tracks: "Sequence[Captured]", options: "LearnOptions", source: str, words: list[str]) -> str:
    """Return the text of the file beside the arrays, with their source and the command that makes them."""
    import tomlkit

    activity = learned.activity
    document = tomlkit.document()
    document.add(tomlkit.comment("Arrays: see `bayes_body.model.dynamics.activity.Activity`. Log-likelihoods are in nats per frame."))
    document["title"] = f"Joint angles of an activity ({', '.join(dict.fromkeys(activity.labels))}) as a hidden Markov model"
    document["source"] = source
    document["body"] = activity.body
    document["motions"] = [track.name for track in tracks]
    document["command"] = " ".join(["bayes-body learn activity-hmm", *words])
    document["fps"] = options.fps
    document["frames"] = sum(len(track.dofs) for track in tracks)
    activities = list(dict.fromkeys(activity.labels))
    document["activities"] = activities
    document["states"] = [activity.labels.count(label) for label in activities]
    document["components"] = options.components
    document["kept"] = round(activity.kept, 3)
    document["log_likelihood_held_out"] = round(learned.held_out, 2)
    document["log_likelihood_training"] = round(learned.training, 2)
    return tomlkit.dumps(document)
