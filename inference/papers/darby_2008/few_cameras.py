"""Track a walk with few cameras: an annealed filter with an activity, one without, and the activity's posterior (Darby, Li & Costen 2008, Fig. 2).

    python inference/papers/darby_2008/few_cameras.py --cameras 2 --runs 10 --json figures.json --plot errors.png --out WALK

Without --session, a walk is filmed with four cameras, 60 frames per second. The first --cameras of them are used.

The optimistic error is that of the best particle. The relative error is measured after both pelvises are put in one place. A run is lost if its mean
relative error over the last LAST_S seconds is above LOST_M: its limbs have nothing to do with the person's by then.
"""

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

import bayes_body as bb
from bayes_body.base.errors import InputError, input_error
from bayes_body.base.files.shipped import definitions_folder
from bayes_body.base.progress import Watch, unwatched
from bayes_body.base.registry import find
from bayes_body.model.definition import Definition, TermDefinition, load_definition
from bayes_body.recording.readers.rig import read_rig
from bayes_body.recording.session.session import Session
from bayes_body.results.metrics.figures import coverage_at
from bayes_body.results.metrics.truth import Accuracy, draws_against_truth, no_truth

sys.path.append(str(Path(__file__).parents[1]))
from error_plot import draw_error_curves
from filmed_walk import film, placed_by_hand

PANELS = {"absolute": "absolute_m", "optimistic": "optimistic_m", "relative": "relative_m"}
# What is compared: the names of the figures.
GUIDED, PLAIN, POSTERIOR = "hmm_apf", "apf", "hmm_tempered"
RIG = "room_4"
LAST_S, LOST_M = 0.5, 0.15


class Followed(NamedTuple):
    """Runs of one definition on one recording.

    Attributes:
        absolute_m: mean error of the markers, metres.
        optimistic_m: that of the best particle.
        relative_m: mean error relative to the pelvis.
        coverage_90: share of true coordinates in the 90 % intervals of each run; NaN for a mode seeker.
        evaluations: of the likelihood per frame.
        log_evidence: per frame, nats, mean over the runs; NaN for a mode seeker.
        seconds: per frame of one run, images included, without compilation.
        fps: of the recording.
    """

    absolute_m: Float[np.ndarray, "run frame"]
    optimistic_m: Float[np.ndarray, "run frame"]
    relative_m: Float[np.ndarray, "run frame"]
    coverage_90: Float[np.ndarray, " run"]
    evaluations: float
    log_evidence: float
    seconds: Float[np.ndarray, " run"]
    fps: float

    @property
    def lost(self) -> int:
        """How many runs lost the person."""
        last = max(1, round(LAST_S * self.fps))
        return int((self.relative_m[:, -last:].mean(axis=1) > LOST_M).sum())

    def figures(self) -> dict[str, Any]:
        """Return means over the frames, as mean and standard deviation over the runs; None for what does not exist."""
        errors = {"absolute_mm": self.absolute_m, "optimistic_mm": self.optimistic_m, "relative_mm": self.relative_m}
        known = np.isfinite(self.coverage_90).all()
        return {
            **{name: _over_runs(1000 * error_m.mean(axis=1)) for name, error_m in errors.items()},
            "lost_runs": self.lost,
            "coverage_90": float(self.coverage_90.mean()) if known else None,
            "evaluations_per_frame": self.evaluations,
            "frames_per_second": float(1 / np.median(self.seconds)),
        }


def _over_runs(values: Float[np.ndarray, " run"]) -> dict[str, float | None]:
    return {"mean": float(values.mean()), "sd": float(values.std(ddof=1)) if len(values) > 1 else None}


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Track a walk with few cameras, with and without an activity.")
    where = parser.add_mutually_exclusive_group(required=True)
    where.add_argument("--session", type=Path, help="folder with a session.toml and true markers")
    where.add_argument("--out", type=Path, help="folder for a walk that is filmed")
    parser.add_argument("--motion", type=Path, help="with --out: a captured walk; by default the walking cycle that ships")
    parser.add_argument("--json", type=Path, required=True, help="file for the figures")
    parser.add_argument("--plot", type=Path, help="file for a picture of the errors, .png")
    parser.add_argument("--cameras", type=bb.whole_number(1), default=2, help="use the first so many (%(default)s); with 1, silhouettes alone")
    parser.add_argument(
        "--activity", help="an activity: a name, or an .npz of `bayes-body learn activity-hmm`; by default people who are not tracked"
    )
    parser.add_argument(
        "--subject", choices=["known", "unknown"], default="unknown", help="whether the activity is the tracked person's (%(default)s)"
    )
    parser.add_argument("--gamma", type=float, help="exponent of the agreement of areas; by default 5 with one camera, else 0")
    parser.add_argument("--methods", nargs="+", choices=["hmm_apf", "apf", "hmm_tempered"], help="only these; all by default")
    parser.add_argument("--runs", type=bb.whole_number(1), default=10, help="runs of each (%(default)s)")
    parser.add_argument("--frames", type=bb.whole_number(1), default=150, help="number of frames (%(default)s)")
    parser.add_argument("--seed", type=bb.whole_number(0), default=0, help="seed of the film and of the first run (%(default)s)")
    parser.add_argument("--quick", action="store_true", help="2 runs, 20 frames, 100 particles at most: a trial")
    arguments = parser.parse_args()
    if arguments.subject == "known" and arguments.activity is None:
        parser.error("--subject known needs --activity, learned from other walks of the tracked person with `bayes-body learn activity-hmm`")
    return arguments


def main() -> None:
    arguments = parse()
    bb.configure()
    frames, runs, most = (20, 2, 100) if arguments.quick else (arguments.frames, arguments.runs, None)
    if arguments.session:
        whole = bb.load_session(arguments.session)
    else:
        rig = read_rig(definitions_folder() / "rigs" / f"{RIG}.toml")
        whole = film(arguments.out, rig, frames, arguments.seed, arguments.motion, "a walk in a room", bb.watched("filming"))
    session = with_cameras(whole, arguments.cameras, arguments.seed)
    definitions = few_camera_definitions(arguments.cameras, arguments.activity, arguments.subject == "known", arguments.gamma)
    tracks = {}
    for name in arguments.methods or definitions:
        usual = definitions[name].kernel.options.particles
        particles = usual if most is None else min(usual, most)
        tracks[name] = follow(session, definitions[name], runs, arguments.seed, frames, particles, bb.watched(name))
    figures = {"cameras": arguments.cameras, "subject": arguments.subject, "runs": runs, **{name: track.figures() for name, track in tracks.items()}}
    arguments.json.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    for name in tracks:
        print(name, *(f"{key} {formatted(value)}" for key, value in figures[name].items()), sep="\n    ")
    if arguments.plot:
        draw_error_curves(arguments.plot, {kind: {name: getattr(track, field) for name, track in tracks.items()} for kind, field in PANELS.items()})


def formatted(value) -> str:
    if isinstance(value, dict):
        return f"{value['mean']:.1f}" + (f" ± {value['sd']:.1f}" if value["sd"] is not None else "")
    return f"{value:.2f}" if isinstance(value, float) else str(value)


def with_cameras(session: Session, count: int, seed: int = 0) -> Session:
    """Return a session with its first cameras only, whose first pose is given: the true markers, with the errors of someone who places them by hand.

    Args:
        session: a recording with truth.
        count: number of cameras.
        seed: of the errors.

    Raises:
        InputError: it has fewer cameras, or no truth.
    """
    if not 1 <= count <= len(session.views):
        raise input_error("cameras", str(count), f"1 to {len(session.views)}, which the session has", "give another number, or another session")
    placed = placed_by_hand(session, seed)
    return replace(session, views=session.views[:count], initial={}, initial_keypoints={}, initial_markers=placed)


def few_camera_definitions(cameras: int, activity: str | None = None, known: bool = False, gamma: float | None = None) -> dict[str, Definition]:
    """Return the definitions that are compared, by the names of their figures.

    Args:
        cameras: their number. With one, silhouettes alone, and the paper's options for this case.
        activity: a name in models/learned/ or the path of an .npz; by default that of the definitions.
        known: whether the activity was learned from the tracked person. Angles beyond its ranges then have no weight.
        gamma: the exponent in (9) of both annealed filters; by default that of their definitions.

    Raises:
        InputError: a definition cannot be read.
    """
    guided = load_definition("darby_2008" if cameras > 1 else "darby_2008_monocular")
    if gamma is not None:
        terms = tuple(replace(term, options=term.options.model_copy(update={"gamma": gamma})) for term in guided.likelihoods)
        guided = replace(guided, likelihoods=terms)
    # The plain filter differs in its motion prior and its number of particles alone.
    apf = load_definition("deutscher_2005")
    kernel = replace(apf.kernel, options=apf.kernel.options.model_copy(update={"particles": 200}))
    plain = replace(guided, dynamics=apf.dynamics, kernel=kernel)
    posterior = load_definition("darby_2008_bayes")
    if activity is not None:
        guided, posterior = (_by_activity(definition, activity, known) for definition in (guided, posterior))
    return {GUIDED: guided, PLAIN: plain, POSTERIOR: posterior}


def _by_activity(definition: Definition, activity: str, known: bool) -> Definition:
    options = definition.dynamics.options.model_copy(update={"activity": activity})
    limits = TermDefinition("training_limits", find("potential", "training_limits").options(activity=activity))
    # A hard limit has no gradient, which the posterior sampler needs.
    constraints = (*definition.constraints, limits) if known and definition.kernel.kind == "annealed" else definition.constraints
    return replace(definition, dynamics=replace(definition.dynamics, options=options), constraints=constraints)


def prior_definitions() -> dict[str, Definition]:
    """Return definitions that differ in their motion prior alone, by its name.

    Raises:
        InputError: a definition cannot be read.
    """
    named = {prior.dynamics.kind: prior.dynamics for prior in map(load_definition, ("walker", "darby_2008_bayes", "silhouettes"))}
    return {name: replace(load_definition("walker"), dynamics=dynamics) for name, dynamics in named.items()}


def follow(
    session: Session,
    definition: Definition,
    runs: int = 1,
    seed: int = 0,
    frames: int | None = None,
    particles: int | None = None,
    watch: Watch = unwatched,
) -> Followed:
    """Track a recording several times with the definition's own kernel, one run after the other, and compare each with the truth.

    Args:
        session: the recording.
        definition: the model.
        runs: their number.
        seed: of the first run; the next ones count up.
        frames: number of frames; all by default.
        particles: per run; by default the definition's.
        watch: wraps the runs to show progress.

    Raises:
        InputError: the definition or the first pose cannot be used, or the session has no truth.
    """
    model, options = bb.load_model(definition, session, lambda line: None), definition.kernel.options
    count = particles or int(options.particles)
    accuracies, coverages, evaluations, log_evidences, seconds = [], [], [], [], []
    for run in watch(range(runs)):
        draws = bb.track(jax.random.key(seed + run), session, model, particles=count, frames=frames)
        against = draws_against_truth(session, draws)
        if against is None:
            raise no_truth(session)
        accuracies.append(against.plain)
        coverages.append(coverage_at(against.plain.coverage, 0.9) if draws.samples_posterior else np.nan)
        evaluations.append(np.mean([np.asarray(frame.info.evaluations) for frame in draws.frames]))
        log_evidences += [np.mean(np.asarray(frame.info.log_evidence)) if draws.samples_posterior else np.nan for frame in draws.frames]
        seconds.append((draws.timing.total - draws.timing.compile) / len(draws.frames))
    return Followed(
        absolute_m=_per_run(accuracies, "frame_error"),
        optimistic_m=_per_run(accuracies, "optimistic"),
        relative_m=_per_run(accuracies, "relative"),
        coverage_90=np.array(coverages),
        evaluations=float(np.mean(evaluations)),
        log_evidence=float(np.mean(log_evidences)),
        seconds=np.array(seconds),
        fps=session.fps,
    )


def _per_run(accuracies: list[Accuracy], name: str) -> Float[np.ndarray, "run frame"]:
    return np.stack([getattr(accuracy, name)[:, 0] for accuracy in accuracies])


if __name__ == "__main__":
    try:
        main()
    except (InputError, OSError) as error:
        print(error, file=sys.stderr)
        sys.exit(2)
