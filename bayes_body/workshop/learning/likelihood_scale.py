r"""Choose the scale of a likelihood that is not a distribution over images, so that intervals contain the truth as often as they should.

A sum of squares is a log-likelihood up to a factor $\rho$ that the images alone do not determine. Simulated recordings with known truth do. Each
recording is tracked for a grid of $\rho$. With the coverage $c(\rho)$ of the 90 % intervals, pooled over recordings, markers and axes,

$$c(\rho^*) = 0.9, \qquad c \text{ interpolated linearly in } \log \rho.$$

If no scale reaches 0.9, because at small ones a wrong motion prior dominates, choose the largest scale whose coverage is within 0.02 of the best.
Four recordings do not determine it better, and the sharper posterior is more useful.

The value is only as good as the recordings. They must not contain people, motions and seeds on which it is used later.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import input_error
from bayes_body.base.progress import Watch, unwatched
from bayes_body.density.kernel import Kernel
from bayes_body.initial import FirstPose, apply_first_pose, first_pose
from bayes_body.model.build import Model, build_model
from bayes_body.model.definition import Definition
from bayes_body.recording.session.session import Session
from bayes_body.results.metrics import accuracy_figures, draws_against_truth, silhouette_overlap
from bayes_body.results.metrics.accuracy import LEVELS
from bayes_body.results.metrics.truth import no_truth
from bayes_body.tracking.track import track
from bayes_body.workshop.calibration.replications import ReplicationLog

LEVEL = 0.9
OPTION = "precision"
# Coverages that differ by at most this count as equal.
NEAR = 0.02
KEPT = "trials"


class Trial(NamedTuple):
    """The result of tracking one recording with one scale.

    Attributes:
        recording: its title.
        scale: the likelihood's scale.
        inside: number of coordinates of true markers inside their 90 % intervals.
        known: number of known coordinates.
        error_mm: mean distance of the markers from the truth.
        iou: median overlap with the silhouettes.
        ess: median effective sample size, particles.
    """

    recording: str
    scale: float
    inside: int
    known: int
    error_mm: float
    iou: float
    ess: float

    @property
    def coverage(self) -> float:
        """The fraction of known coordinates inside their intervals."""
        return self.inside / self.known


def with_scale(definition: Definition, scale: float) -> Definition:
    """The definition with this scale in its likelihood.

    Raises:
        InputError: none of its likelihoods has a scale, or more than one has.
    """
    scaled = [index for index, term in enumerate(definition.likelihoods) if hasattr(term.options, OPTION)]
    if len(scaled) != 1:
        problem = f"it has {len(scaled)} likelihoods with a {OPTION}"
        raise input_error(f"the model '{definition.name}'", problem, "one", "a distribution over images needs no scale; scale several one at a time")
    terms = list(definition.likelihoods)
    terms[scaled[0]] = replace(terms[scaled[0]], options=terms[scaled[0]].options.model_copy(update={OPTION: scale}))
    return replace(definition, likelihoods=tuple(terms))


def trials(
    sessions: Sequence[Session],
    definition: Definition,
    scales: Sequence[float],
    kernel: Kernel,
    particles: int,
    seed: int = 0,
    frames: int | None = None,
    log: ReplicationLog | None = None,
    watch: Watch = unwatched,
) -> Iterator[Trial]:
    """Track each recording with each scale, all from the same first pose.

    Args:
        sessions: recordings with truth.
        definition: the model.
        scales: the scales to try.
        kernel: a posterior sampler; the intervals of a mode seeker mean nothing.
        particles: number of particles of a run.
        seed: the seed of everything random.
        frames: use only this many frames, from the first.
        log: existing trials, to which new ones are added.
        watch: wraps the iteration over trials, to show progress.

    Raises:
        InputError: a session has no truth, or the model no scale.
    """
    for session in sessions:
        if session.truth_path is None:
            raise no_truth(session)
    log = ReplicationLog() if log is None else log
    starts: dict[int, FirstPose] = {}
    for number in watch(range(len(sessions) * len(scales))):
        place, scale = number // len(scales), scales[number % len(scales)]
        if (KEPT, number) not in log:
            model = build_model(with_scale(definition, scale), sessions[place])
            if place not in starts:
                # The fit of the first pose does not use the images, so it is the same for each scale.
                starts[place] = first_pose(model, sessions[place], "fitted")
            trial = _trial(sessions[place], apply_first_pose(model, sessions[place], starts[place]), scale, kernel, particles, seed, frames)
            # Only numbers: the log does not store text.
            log.add(KEPT, number, {name: np.asarray(value) for name, value in trial._asdict().items() if name != "recording"})
        yield Trial(sessions[place].title, **{name: value.item() for name, value in log[KEPT, number].items()})


def _trial(session: Session, model: Model, scale: float, kernel: Kernel, particles: int, seed: int, frames: int | None) -> Trial:
    draws = track(jax.random.key(seed), session, model, kernel, particles, frames=min(frames or session.frames, session.frames))
    comparison = draws_against_truth(session, draws)
    if comparison is None:
        raise input_error(
            f"the model '{model.definition.name}'", "none of its markers is in the truth", "a model with such markers", "use another body"
        )
    if not draws.samples_posterior:
        raise input_error("--kernel", "a mode seeker", "a kernel whose particles are draws from the posterior", "use sir or tempered")
    figures = accuracy_figures(comparison, mode_seeker=False)
    inside, coordinates = int(comparison.plain.inside[LEVELS.index(LEVEL)].sum()), int(comparison.plain.known.sum())
    iou = float(np.nanmedian(silhouette_overlap(session, draws)))
    return Trial(session.title, scale, inside, coordinates, figures["error_mm_mean"], iou, float(np.median(draws.info.ess)))


def pooled(runs: Sequence[Trial]) -> tuple[Float[np.ndarray, " scale"], Float[np.ndarray, " scale"]]:
    """The scales, ascending, and the coverage of all recordings together."""
    scales = sorted({trial.scale for trial in runs})
    groups = [[trial for trial in runs if trial.scale == scale] for scale in scales]
    return np.array(scales), np.array([sum(t.inside for t in group) / sum(t.known for t in group) for group in groups])


def choose_scale(scales: Float[np.ndarray, " scale"], coverage: Float[np.ndarray, " scale"], level: float = LEVEL) -> float:
    """The largest scale at which the decreasing coverage crosses the level; otherwise the largest scale that is about as good as the best.

    Raises:
        InputError: neither exists within the scales.
    """
    last_good = int(np.flatnonzero(coverage >= coverage.max() - NEAR)[-1])
    if coverage.max() < level and 0 < last_good < len(scales) - 1:
        return float(scales[last_good])
    crossing = [k for k in range(len(scales) - 1) if coverage[k] >= level > coverage[k + 1]]
    if not crossing:
        problem = f"coverage from {coverage.min():.2f} to {coverage.max():.2f} for scales from {scales[0]:g} to {scales[-1]:g}"
        remedy = "try smaller ones" if coverage.max() < level else "try larger ones"
        raise input_error("--scales", problem, f"a coverage that crosses {level:g}", remedy)
    k = crossing[-1]
    share = (coverage[k] - level) / (coverage[k] - coverage[k + 1])
    return float(np.exp((1 - share) * np.log(scales[k]) + share * np.log(scales[k + 1])))
