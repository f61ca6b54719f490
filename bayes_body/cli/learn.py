"""`bayes-body learn`: its verbs, and one of them: `likelihood-scale` learns the scale of a likelihood from recordings with known truth."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from bayes_body.base.errors import input_error
from bayes_body.cli.learn_motion import activity_hmm, walking_angles, walking_cycle
from bayes_body.cli.learn_potentials import kinematic_potentials
from bayes_body.cli.terminal import say
from bayes_body.cli.track import check_range
from bayes_body.runs.limits import LARGEST_SEED

if TYPE_CHECKING:
    from bayes_body.workshop.learning.likelihood_scale import Trial

SCALES = "2,4,8,16,32"
HEADINGS = f"{'recording':32} {'scale':>7} {'coverage of 90 %':>17} {'error mm':>9} {'overlap':>8} {'ESS':>6}"


def likelihood_scale(
    sessions: list[Path] = typer.Argument(help="Folders of recordings with their truth, such as those made by `bayes-body simulate`."),
    model: str = typer.Option(
        "silhouettes", "--model", help="A definition's name or the path of your own; one of its likelihoods has a `precision`."
    ),
    scales: str = typer.Option(SCALES, "--scales", help="Values of `precision` to try, separated by commas."),
    kernel: str | None = typer.Option(None, "--kernel", help="sir or tempered; the model's own by default."),
    particles: int | None = typer.Option(None, "--particles", help="Particles per run."),
    frames: int | None = typer.Option(None, "--frames", help="Number of frames of each recording, from the first on; all by default."),
    seed: int = typer.Option(0, "--seed", help="Seed of everything random."),
    json_file: Path | None = typer.Option(
        None, "--json", help="File for all figures. Until all are computed, the finished part is in a file beside it; the same command continues it."
    ),
) -> None:
    """Find the `precision` at which 90 % intervals contain the truth in nine of ten cases."""
    from bayes_body.base.config import configure

    configure()
    from bayes_body.cli.models import checked_definition
    from bayes_body.model.kernel_options import kernel_options
    from bayes_body.workshop.learning.likelihood_scale import LEVEL, choose_scale, pooled

    check_range("--particles", particles, 1)
    check_range("--frames", frames, 1)
    check_range("--seed", seed, 0, LARGEST_SEED)
    tried, definition = _numbers(scales), checked_definition(model)
    kind, options = kernel_options(definition, kernel, {} if particles is None else {"particles": particles})
    # A trial is identified by the recording's number: the same recordings in the same order give the same trials.
    settings = {"recordings": [path.name for path in sessions], "model": definition.text, "body": definition.body_text, "scales": tried}
    settings |= {"kernel": kind, "options": options.model_dump(), "frames": frames, "seed": seed}
    outcomes = _tried(sessions, definition, tried, kind, options, settings, json_file)
    ascending_scales, coverage = pooled(outcomes)
    for scale, share in zip(ascending_scales, coverage, strict=True):
        say(f"{'all':32} {scale:7g} {share:17.3f}")
    chosen = choose_scale(ascending_scales, coverage)
    if json_file is not None:
        _write(json_file, settings | {"trials": [trial._asdict() for trial in outcomes], "coverage_90": coverage.tolist(), "precision": chosen})
    if coverage.max() < LEVEL:
        say(f"no scale reaches {LEVEL:.0%}: small ones are limited by the motion prior, large ones by the misfit; the largest of the best is used")
    say(f"precision = {chosen:.3g}")


def _tried(
    sessions: list[Path], definition: Any, scales: list[float], kind: str, options: Any, settings: dict[str, Any], out: Path | None
) -> "list[Trial]":
    """Return all trials; each is printed as soon as it is computed."""
    from bayes_body.base.progress import watched
    from bayes_body.base.registry import find
    from bayes_body.recording.session.read import load_session
    from bayes_body.workshop.calibration.replications import SUFFIX, ReplicationLog
    from bayes_body.workshop.learning.likelihood_scale import trials

    kernel, outcomes = find("kernel", kind).build(options=options), []
    loaded = [load_session(path) for path in sessions]
    log = ReplicationLog(None if out is None else out.with_name(out.name + SUFFIX), settings)
    say(HEADINGS)
    watch = watched("recordings × scales")
    for trial in trials(loaded, definition, scales, kernel, options.particles, settings["seed"], settings["frames"], log, watch):
        say(f"{trial.recording[:32]:32} {trial.scale:7g} {trial.coverage:17.3f} {trial.error_mm:9.1f} {trial.iou:8.3f} {trial.ess:6.0f}")
        outcomes.append(trial)
    return outcomes


def _numbers(text: str) -> list[float]:
    """Return the scales, ascending."""
    try:
        scales = sorted({float(word) for word in text.split(",")})
    except ValueError:
        scales = []
    if len(scales) < 2 or not all(0 < value < float("inf") for value in scales):
        raise input_error("--scales", repr(text), "two or more numbers above 0, separated by commas", f"give for example {SCALES}")
    return scales


def _write(path: Path, figures: dict[str, Any]) -> None:
    from bayes_body.base.files.atomic import write_text
    from bayes_body.workshop.calibration.replications import SUFFIX

    write_text(path, json.dumps(figures, indent=2) + "\n")
    path.with_name(path.name + SUFFIX).unlink(missing_ok=True)


app = typer.Typer(help="Learn from captured motion, or from recordings with their truth.", no_args_is_help=True)
app.command("likelihood-scale", short_help="The precision at which 90 % intervals hold.")(likelihood_scale)
app.command("walking-angles", short_help="The mean stride of several people.")(walking_angles)
app.command("kinematic-potentials", short_help="The joints of a loose-limbed body.")(kinematic_potentials)
app.command("activity-hmm", short_help="A hidden Markov model of an activity.")(activity_hmm)
app.command("walking-cycle", short_help="A walker's stride and its main changes.")(walking_cycle)
