"""Tracking with few cameras: an annealed filter guided by an activity, one without, and the posterior of the activity (Darby, Li & Costen 2008, 7).

The optimistic error is that of the best particle. The relative error is measured after both pelvises are put in one place. A run is lost if its mean
relative error over the last LAST_S seconds is above LOST_M: its limbs have nothing to do with the person's by then.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from bayes_body.compare.image_motion import by_hand, film
from bayes_body.errors import input_error
from bayes_body.files.shipped import definitions_folder
from bayes_body.initial import load_model
from bayes_body.metrics.figures import coverage_at
from bayes_body.metrics.truth import Accuracy, draws_against_truth, no_truth
from bayes_body.model.definition import Definition, TermDefinition, load_definition
from bayes_body.recording.rig import read_rig
from bayes_body.registry import find
from bayes_body.session.session import Session
from bayes_body.tracking.track import track
from bayes_body.view.progress import Watch, unwatched

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
        seconds: per frame of one run, images included, without compilation.
        fps: of the recording.
    """

    absolute_m: Float[np.ndarray, "run frame"]
    optimistic_m: Float[np.ndarray, "run frame"]
    relative_m: Float[np.ndarray, "run frame"]
    coverage_90: Float[np.ndarray, " run"]
    evaluations: float
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
            **{name: _over_runs(1000 * each.mean(axis=1)) for name, each in errors.items()},
            "lost_runs": self.lost,
            "coverage_90": float(self.coverage_90.mean()) if known else None,
            "evaluations_per_frame": self.evaluations,
            "frames_per_second": float(1 / np.median(self.seconds)),
        }


def _over_runs(values: Float[np.ndarray, " run"]) -> dict[str, float | None]:
    return {"mean": float(values.mean()), "sd": float(values.std(ddof=1)) if len(values) > 1 else None}


def film_in_room(folder: Path, frames: int = 150, seed: int = 0, motion: Path | None = None, watch: Watch = unwatched) -> Session:
    """Film a walk with the four cameras of a room, 60 frames per second, and write the session.

    Args:
        folder: the session's folder.
        frames: number of frames.
        seed: of the person, the room and the noise.
        motion: a captured walk; by default the walking cycle that ships.
        watch: wraps the frames to show progress.

    Raises:
        InputError: the folder already holds a session, or the motion cannot be read or is too short.
    """
    return film(folder, read_rig(definitions_folder() / "rigs" / f"{RIG}.toml"), frames, seed, motion, "a walk in a room", watch)


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
    placed = by_hand(session, seed)
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
    apf = load_definition("deutscher_apf")
    kernel = replace(apf.kernel, options=apf.kernel.options.model_copy(update={"particles": 200}))
    plain = replace(guided, dynamics=apf.dynamics, kernel=kernel)
    posterior = load_definition("darby_2008_bayes")
    if activity is not None:
        guided, posterior = (_by_activity(each, activity, known) for each in (guided, posterior))
    return {GUIDED: guided, PLAIN: plain, POSTERIOR: posterior}


def _by_activity(definition: Definition, activity: str, known: bool) -> Definition:
    options = definition.dynamics.options.model_copy(update={"activity": activity})
    limits = TermDefinition("training_limits", find("potential", "training_limits").options(activity=activity))
    # A hard limit has no gradient, which the posterior sampler needs.
    constraints = (*definition.constraints, limits) if known and definition.kernel.kind == "annealed" else definition.constraints
    return replace(definition, dynamics=replace(definition.dynamics, options=options), constraints=constraints)


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
    model, options = load_model(definition, session, lambda line: None), definition.kernel.options
    term, count = find("kernel", definition.kernel.kind), particles or int(options.particles)
    kernel, mode_seeker = term.build(options=options), bool(term.note)
    found, evaluations, seconds = [], [], []
    for run in watch(range(runs)):
        draws = track(jax.random.key(seed + run), session, model, kernel, count, frames=frames)
        against = draws_against_truth(session, draws)
        if against is None:
            raise no_truth(session)
        found.append(against.plain)
        evaluations.append(np.mean([np.asarray(frame.info.evaluations) for frame in draws.frames]))
        seconds.append((draws.timing.total - draws.timing.compile) / len(draws.frames))
    return Followed(
        absolute_m=_of(found, "frame_error"),
        optimistic_m=_of(found, "optimistic"),
        relative_m=_of(found, "relative"),
        coverage_90=np.array([np.nan if mode_seeker else coverage_at(each.coverage, 0.9) for each in found]),
        evaluations=float(np.mean(evaluations)),
        seconds=np.array(seconds),
        fps=session.fps,
    )


def _of(found: list[Accuracy], name: str) -> Float[np.ndarray, "run frame"]:
    return np.stack([getattr(each, name)[:, 0] for each in found])
