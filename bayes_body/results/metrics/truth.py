r"""Compare a whole run with the truth, frame by frame: directly, and with the offset between the joint centres of the two skeletons fitted.

Two skeletons are never the same: the truth's "hip" is not where the body's hip joint is. An offset that is constant over the frames, in the joint's
frame, is not a tracking error. For each marker m, on a joint with the orientation $R_t$ in the run's mean pose, the offset

$$\delta_m = \arg\min_\delta \sum_t \| \bar x_{t,m} + R_t \delta - z_{t,m} \|^2 = \mathrm{mean}_t\; R_t^\top (z_{t,m} - \bar x_{t,m})$$

is fitted on every other frame and added to the body's marker in the frames between, and vice versa. So no frame is measured with an offset to which
it contributed.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import NDArray

from bayes_body.base.errors import InputError, input_error
from bayes_body.base.progress import Watch, unwatched
from bayes_body.base.shapes import Configuration
from bayes_body.model.body.placed_body import joint_transforms
from bayes_body.model.body.skeleton import Markers
from bayes_body.model.body.solids import Body, configuration_space
from bayes_body.model.build import Model
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.readers.truth import read_truth
from bayes_body.recording.session.session import Session
from bayes_body.results.metrics.accuracy import LEVELS, FrameAccuracy, frame_accuracy
from bayes_body.results.metrics.angles import AngleAccuracy, TrueAngles, angles_against_truth, true_angles
from bayes_body.results.metrics.by_frame import stack_frames
from bayes_body.results.metrics.calibration import Scores
from bayes_body.results.metrics.clouds import Cloud, Clouds, weights_of
from bayes_body.results.metrics.scores import FrameScores, frame_scores
from bayes_body.results.posterior import markers
from bayes_body.tracking.draws import Draws

# With fewer frames with a known truth, no offset is fitted.
FEWEST = 10
# Seed of the random reference points.
REFERENCES = 0


class Accuracy(NamedTuple):
    """Some frames compared with the truth, metres; NaN where the truth is unknown. `FrameAccuracy` explains the fields.

    Attributes:
        names: names of the markers that both the body and the truth have.
        error: error of each marker.
        relative: mean error relative to the pelvis.
        optimistic: mean error of the best particle.
        expected: quantiles of the expected error at SHARES, mean over the runs.
        inside: number of frames, runs and axes in which the truth is inside the interval of each of LEVELS.
        known: number of frames, runs and axes in which the truth is known.
        residual: vector from the mean marker to the true one, in the frame of the marker's joint, mean over the runs.
        scores: calibration, CRPS and spread; None with an offset.
    """

    names: tuple[str, ...]
    error: Float[np.ndarray, "frame run marker"]
    relative: Float[np.ndarray, "frame run"]
    optimistic: Float[np.ndarray, "frame run"]
    expected: Float[np.ndarray, "frame share"]
    inside: Int[np.ndarray, "level marker"]
    known: Int[np.ndarray, " marker"]
    residual: Float[np.ndarray, "frame marker 3"]
    scores: Scores | None = None

    @property
    def frame_error(self) -> Float[np.ndarray, "frame run"]:
        """Mean error of a frame's known markers, metres."""
        return mean_known(self.error, -1)

    @property
    def coverage(self) -> Float[np.ndarray, " level"]:
        """Fraction of frames, runs, markers and axes with the truth inside, for each of LEVELS; NaN if no truth is known."""
        return shares(self.inside.sum(axis=-1), self.known.sum())

    @property
    def coverage_by_marker(self) -> Float[np.ndarray, "level marker"]:
        """Coverage of each marker."""
        return shares(self.inside, self.known)


class AgainstTruth(NamedTuple):
    """A run compared with the truth.

    Attributes:
        plain: accuracy of the body's markers without an offset.
        fitted: accuracy with the offset fitted on the other half of the frames; None with fewer than FEWEST frames with a known truth.
        offsets: offsets fitted on all frames, in the frame of the marker's joint, metres; NaN for a marker that is never known.
        angles: the clinical angles compared with the true ones; None if the truth has none of this body.
    """

    plain: Accuracy
    fitted: Accuracy | None
    offsets: Float[np.ndarray, "marker 3"]
    angles: AngleAccuracy | None = None


def true_markers(session: Session) -> Float[np.ndarray, "frame 15 3"] | None:
    """Return the session's true markers, in the order of `evidence.markers.MARKERS`, metres; None if the session names none.

    Raises:
        InputError: the file that the session names cannot be used.
    """
    return None if session.truth_path is None else read_truth(session.truth_path, session.frames, session.skipped)


def draws_against_truth(session: Session, draws: Draws, watch: Watch = unwatched) -> AgainstTruth | None:
    """Compare draws with the session's truth; None if it has no truth, or none for the body's markers.

    Args:
        session: the recording.
        draws: draws of the recording's first frames.
        watch: wraps the frames' numbers to show progress; used twice, the second time with the offsets.

    Raises:
        InputError: the session's truth cannot be used.
    """
    truth = true_markers(session)
    if truth is None:
        return None
    frames = range(len(draws.frames))
    angles = true_angles(session, draws.model)
    angles = None if angles is None else angles.select(frames)
    return against_truth(draws.model, lambda: (_cloud(draws, index) for index in watch(frames)), truth[: len(frames)], angles)


class Common(NamedTuple):
    """The markers that body and truth share: their names, and their places among the body's. Unknowns change all markers of a body at once."""

    names: tuple[str, ...]
    places: tuple[int, ...]


def _cloud(draws: Draws, index: int) -> Cloud:
    frame = draws.frames[index]
    variable, *body_terms = draws.model.placing
    return Cloud(frame.states[variable], frame.log_weights, {name: frame.states[name] for name in body_terms})


def against_truth(model: Model, clouds: Clouds, truth: Float[np.ndarray, "frame 15 3"], angles: TrueAngles | None = None) -> AgainstTruth | None:
    """Compare particles with the truth, with one frame in memory at a time; None if body and truth share no marker.

    Args:
        model: the run's model.
        clouds: returns a new iterator over the particles of each frame at each call.
        truth: true markers in the same frames, in the order of `evidence.markers.MARKERS`, metres; NaN where unknown.
        angles: true clinical angles in the same frames, if they are known.
    """
    body = model.body.markers
    places = [place for place, name in enumerate(body.names) if name in MARKERS]
    if not places:
        return None
    names = tuple(body.names[place] for place in places)
    common = Common(names, tuple(places))
    true = truth[:, [MARKERS.index(name) for name in names]]
    folds = _folds(true)
    plain = _accuracy(model, common, clouds, true, np.zeros((1, len(names), 3)), np.zeros_like(folds), scored=True)
    fitted = None
    if np.isfinite(true).all(axis=-1).any(axis=-1).sum() >= FEWEST:
        offsets = np.stack([mean_known(plain.residual[folds != fold], 0) for fold in range(2)])
        fitted = _accuracy(model, common, clouds, true, offsets, folds)
    angle_accuracy = None if angles is None else angles_against_truth(model, clouds, angles)
    return AgainstTruth(plain, fitted, mean_known(plain.residual, 0), angle_accuracy)


def _folds(truth: Float[np.ndarray, "frame marker 3"]) -> Int[np.ndarray, " frame"]:
    """Return the half to which each frame belongs. The halves alternate over the frames whose truth is known, which may be only every other frame."""
    return np.cumsum(np.isfinite(truth).all(axis=-1).any(axis=-1)) % 2


def _accuracy(
    model: Model,
    common: Common,
    clouds: Clouds,
    truth: Float[np.ndarray, "frame marker 3"],
    offsets: Float[np.ndarray, "fold marker 3"],
    folds: Int[np.ndarray, " frame"],
    scored: bool = False,
) -> Accuracy:
    """Return the accuracy over all frames, each with its fold's offset added to the markers. The truth of a marker without an offset is unknown."""
    inside, rng = np.zeros((len(LEVELS), len(common.names)), int), np.random.default_rng(REFERENCES)
    moved = [replace(model, body=replace(model.body, markers=_moved(model.body.markers, common, offset))) for offset in offsets]
    fold_truth = np.where(np.isfinite(offsets[folds]), truth, np.nan)

    def frames() -> Iterator[_Frame]:
        for cloud, true, fold in zip(clouds(), fold_truth, folds, strict=True):
            noise = rng.standard_normal(true.shape) if scored else None
            changes = [{name: values[run] for name, values in cloud.changes.items()} for run in range(len(cloud.poses))]
            particles = zip(cloud.poses, cloud.log_weights, changes, strict=True)
            runs = [_of_run(moved[fold], common, *run_particles, true, noise) for run_particles in particles]
            inside[:] += np.sum([run.accuracy.inside for run in runs], axis=(0, -1))
            yield _of_runs(runs)

    by_frame = stack_frames(frames())
    count = 3 * np.isfinite(by_frame.error).sum(axis=(0, 1))
    return Accuracy(
        common.names, by_frame.error, by_frame.relative, by_frame.optimistic, by_frame.expected, inside, count, by_frame.residual, by_frame.scores
    )


def _moved(markers: Markers, common: Common, offset: Float[np.ndarray, "marker 3"]) -> Markers:
    step = jnp.asarray(np.nan_to_num(offset), markers.offsets.dtype)
    return replace(markers, offsets=markers.offsets.at[jnp.array(common.places)].add(step))


class _Run(NamedTuple):
    """One frame of one run: accuracy, the residual in the frame of each marker's joint, and scores if they are wanted."""

    accuracy: FrameAccuracy
    residual: Float[np.ndarray, "marker 3"]
    scores: FrameScores | None


def _of_run(
    model: Model,
    common: Common,
    poses: Float[np.ndarray, "particle *shape"],
    log_weights: Float[np.ndarray, " particle"],
    changes: Mapping[str, Float[np.ndarray, "particle entry"]],
    truth: Float[np.ndarray, "marker 3"],
    noise: Float[np.ndarray, "marker 3"] | None,
) -> _Run:
    weights, places = weights_of(log_weights), list(common.places)
    positions = markers(model, poses, **changes)[:, places]
    mean = configuration_space(model.body).mean(weights, poses)
    turned = np.asarray(_orientations(model.body, jnp.asarray(mean, model.body.lengths.dtype)), float)[places]
    accuracy = frame_accuracy(positions, weights, truth, common.names)
    scores = None if noise is None else frame_scores(positions, weights, truth, noise)
    return _Run(accuracy, np.einsum("mki,mk->mi", turned, accuracy.off), scores)


class _Frame(NamedTuple):
    """What stays of a frame: errors of each run, means over the runs of the expected error and of the residual, and scores of each run."""

    error: Float[np.ndarray, "run marker"]
    relative: Float[np.ndarray, " run"]
    optimistic: Float[np.ndarray, " run"]
    expected: Float[np.ndarray, " share"]
    residual: Float[np.ndarray, "marker 3"]
    scores: Scores | None


def _of_runs(runs: Sequence[_Run]) -> _Frame:
    by_run, scores = [run.accuracy for run in runs], [run.scores for run in runs if run.scores is not None]
    error, relative, optimistic = (np.array([getattr(run, name) for run in by_run]) for name in ("error", "relative", "optimistic"))
    expected, residual = np.mean([run.expected for run in by_run], axis=0), np.mean([run.residual for run in runs], axis=0)
    scores_by_run = Scores(*(np.array([getattr(run, name) for run in scores]) for name in Scores._fields)) if scores else None
    return _Frame(error, relative, optimistic, expected, residual, scores_by_run)


@jax.jit
def _orientations(body: Body, configuration: Configuration) -> Float[Array, "marker 3 3"]:
    """Return `R_world_joint` of each marker's joint."""
    return joint_transforms(body, configuration).rotation[np.array(body.markers.joints, int)]


def no_truth(session: Session) -> InputError:
    """Return the error of a session without truth."""
    return input_error(session.folder, "no truth", "a session with true markers", "make one with `bayes-body simulate`")


def mean_known(values: NDArray[np.floating], axis: int | tuple[int, ...]) -> NDArray[np.floating]:
    """Return the mean of the values that are not NaN; NaN if there are none."""
    is_finite = np.isfinite(values)
    return shares(np.where(is_finite, values, 0).sum(axis=axis), is_finite.sum(axis=axis))


def shares(part: NDArray[np.number], totals: NDArray[np.integer]) -> NDArray[np.floating]:
    """Return `part / totals`; NaN where the total is 0."""
    return np.divide(part, totals, out=np.full(np.shape(part), np.nan), where=totals > 0)
