"""The numbers of the posterior predictive check: what the draws of a run predict in each camera, compared with what was seen there, at a few frames.

The check uses at most FRAMES frames and DRAWS draws of equal weight, so that its cost does not grow with the run.

For keypoints, the pixels that draws of the state and of the likelihood's noise predict are compared with the seen pixels. With z the seen pixels, s a
draw of the pose and of what is not known of body and cameras, and z' a draw of the keypoints given s, the predictive distribution is that of z' over
both (Gelman, Meng & Stern 1996). The error of a keypoint is its distance from the mean of the pixels that the draws expect.
"""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray, Shaped

from bayes_body.base.errors import InputError, input_error
from bayes_body.base.progress import Watch, unwatched
from bayes_body.base.shapes import Key
from bayes_body.density.factor import State, variables
from bayes_body.model.body.solids import configuration_space
from bayes_body.model.build import Model
from bayes_body.model.likelihood.detections import Detections
from bayes_body.model.likelihood.markers_gaussian import MarkersGaussian
from bayes_body.model.unknowns.apply import Unknowns, node_of, with_changes
from bayes_body.recording.observation.frames import Frame, read_frame
from bayes_body.results.metrics.fit import frame_near, seen_in
from bayes_body.results.posterior.blocks import pooled, pose_blocks, weights_of_runs
from bayes_body.results.posterior.resampling import RESAMPLING_SEED, systematic_resampling
from bayes_body.view.report.predicted_silhouettes import SilhouetteCheck, reads_silhouettes, silhouette_check

if TYPE_CHECKING:
    from bayes_body.results.storage.saved_run import SavedRun

# Draws of the noise for each draw of the pose.
NOISES = 5
ENDS = (0.05, 0.95)
# Percentiles of errors.
SHOWN = (50, 90)


class KeypointCheck(NamedTuple):
    """The comparison of one frame's keypoints; pixels.

    Attributes:
        error: distance of each seen keypoint from the mean of the pixels that the draws expect; NaN where it is not seen.
        expected: median and 90 % quantile of the same distance of predicted keypoints, over the seen markers; NaN for a camera without any.
        inside: share of a keypoint's two coordinates inside their 90 % predictive intervals; NaN where it is not seen.
    """

    error: Float[np.ndarray, "camera marker"]
    expected: Float[np.ndarray, "camera share"]
    inside: Float[np.ndarray, "camera marker"]


class KeypointLikelihood(NamedTuple):
    """A model's likelihood of keypoints.

    Attributes:
        name: of the factor.
        markers: the distribution, as the session has it.
        terms: the unknowns that change it.
    """

    name: str
    markers: MarkersGaussian
    terms: Unknowns


def keypoint_likelihood(model: Model) -> KeypointLikelihood | None:
    """Return the model's likelihood of keypoints; None if the model has none."""
    for factor in model.factors:
        markers = node_of(factor, MarkersGaussian)
        if markers is not None:
            return KeypointLikelihood(factor.name, markers, tuple(term for term in model.unknowns if term.concerns(factor)))
    return None


def noise_in_words(detections: Detections) -> str:
    """Return for example `Gaussian with a standard deviation of 8 px in each coordinate`."""
    low, high = float(detections.sd_px.min()), float(detections.sd_px.max())
    width = f"{low:.3g} px" if high - low < 0.01 * high else f"{low:.3g} to {high:.3g} px by camera"
    named = f"Gaussian with a standard deviation of {width} in each coordinate"
    if detections.noise == "student":
        named = f"Student's t with {float(detections.degrees_of_freedom):g} degrees of freedom and a scale of {width}"
    confident = ", divided by a power of the confidence" if detections.by_confidence else ""
    return f"{named}{confident}{f', and {100 * detections.outliers:g} % outliers' if detections.outliers else ''}"


def keypoint_check(
    detections: Detections, expected: Float[np.ndarray, "draw camera marker entry"], keypoints: Float[np.ndarray, "camera marker 3"], key: Key
) -> KeypointCheck:
    """Compare a frame's keypoints with their predictive distribution.

    Args:
        detections: the distribution of the keypoints in the likelihood.
        expected: from `expected_keypoints`.
        keypoints: column, row and confidence of the keypoints.
        key: random key of the noise.
    """
    present = keypoints[..., 2] > float(detections.least_confidence)
    middle = expected[..., :2].mean(axis=0)
    drawn = predicted_pixels(detections, expected, np.where(present, keypoints[..., 2], 1.0), key)
    # With this definition of the quantile, a new draw from the same distribution is inside with probability 0.9, however few draws there are.
    low, high = np.quantile(drawn, ENDS, axis=0, method="weibull")
    inside = ((low <= keypoints[..., :2]) & (keypoints[..., :2] <= high)).mean(axis=-1)
    distances = np.linalg.norm(drawn - middle, axis=-1)
    shares = np.array([np.percentile(distances[:, c, mask], SHOWN) if mask.any() else (np.nan, np.nan) for c, mask in enumerate(present)])
    error = np.linalg.norm(keypoints[..., :2] - middle, axis=-1)
    return KeypointCheck(np.where(present, error, np.nan), shares, np.where(present, inside, np.nan))


def expected_keypoints(
    likelihood: KeypointLikelihood, states: Mapping[str, Float[np.ndarray, "draw *shape"]]
) -> Float[np.ndarray, "draw camera marker entry"]:
    """Return the pixels at which each draw expects the markers, without noise; a third entry is the log of a factor of the noise.

    Args:
        likelihood: the model's.
        states: draws of the model's variables, by name.
    """
    terms = tuple(term for term in likelihood.terms if {term.name, *term.reads} <= states.keys())
    return np.asarray(_expected(likelihood.markers, terms, {name: value.astype(np.float32) for name, value in states.items()}))


def predicted_pixels(
    detections: Detections,
    expected: Float[np.ndarray, "draw camera marker entry"],
    confidence: Float[np.ndarray, "camera marker"],
    key: Key,
) -> Float[np.ndarray, "drawn camera marker 2"]:
    """Return NOISES draws of the keypoints for each draw of the state; the first noise of all draws comes first."""
    keys = jax.random.split(key, (NOISES, len(expected)))
    drawn = np.asarray(_drawn(detections, keys, expected, confidence))
    return drawn.reshape(-1, *drawn.shape[2:])


@jax.jit
def _expected(markers: MarkersGaussian, terms: Unknowns, states: State) -> Float[Array, "draw camera marker entry"]:
    def expected(state: State) -> Float[Array, "camera marker entry"]:
        changed = with_changes(terms, markers, variables(state))
        return changed.expected(state[changed.body.variable])

    return jax.vmap(expected)(states)


@jax.jit
def _drawn(
    detections: Detections,
    keys: Shaped[PRNGKeyArray, "noise draw"],
    expected: Float[Array, "draw camera marker entry"],
    confidence: Float[Array, "camera marker"],
) -> Float[Array, "noise draw camera marker 2"]:
    by_state = jax.vmap(detections.draw_about, (0, 0, None))
    return jax.vmap(by_state, (0, None, None))(keys, expected, confidence)


FRAMES, DRAWS = 20, 60
NOTHING = "The model reads neither keypoints nor silhouettes, so there is nothing to compare with its predictions."


class Predicted(NamedTuple):
    """The compared frames.

    Attributes:
        frames: their numbers.
        draws: number of draws of the pose.
        keypoints: arrays with the frame as first axis; None if the model reads no keypoints.
        silhouettes: the same; None if the model reads no silhouettes.
    """

    frames: Int[np.ndarray, " frame"]
    draws: int
    keypoints: KeypointCheck | None
    silhouettes: SilhouetteCheck | None


class Moment(NamedTuple):
    """One frame of the run.

    Attributes:
        model: the model with its cameras where they are in this frame.
        frame: what was seen.
        states: draws of equal weight of all runs together, by variable: what places the body, and the unknowns; for a mode seeker their mean alone.
        key: random key of the noise in this frame.
    """

    model: Model
    frame: Frame
    states: dict[str, Float[np.ndarray, "draw *shape"]]
    key: jax.Array


def prediction_of(run: "SavedRun", watch: Watch = unwatched) -> Predicted | str:
    """Compare a run with its recording at no more than FRAMES evenly spaced frames. Return a sentence that says why if they cannot be compared.

    Args:
        run: the run.
        watch: wraps the frames to show progress.
    """
    try:
        _check_recording(run)
        if keypoint_likelihood(run.model) is None and not reads_silhouettes(run.model):
            return NOTHING
        return _predicted(run, watch)
    except InputError as error:
        return f"The run can no longer be compared with its recording: {error}."


def _check_recording(run: "SavedRun") -> None:
    """Refuse a recording that is not the one from which the run was made. A stranger's run may name any file of this machine.

    Raises:
        InputError: it has changed or is gone, or it can no longer be read.
    """
    changed = sorted(run.changed_inputs - {"truth"})
    if changed:
        more = f" and {len(changed) - 1} more" if len(changed) > 1 else ""
        raise input_error(f"{changed[0]}{more}", "changed or gone since the run was made", "the recording of the run", "put it back")


def _predicted(run: "SavedRun", watch: Watch) -> Predicted:
    frames = np.unique(np.linspace(0, run.frames - 1, FRAMES).round().astype(int))
    keypoints, silhouettes, draws = [], [], 0
    for index in watch(frames.tolist()):
        inspection = moment(run, index)
        draws = len(inspection.states[inspection.model.body.variable])
        likelihood = keypoint_likelihood(inspection.model)
        if likelihood is not None:
            expected, detected = expected_keypoints(likelihood, inspection.states), seen_keypoints(inspection, likelihood)
            keypoints.append(keypoint_check(likelihood.markers.detections, expected, detected, inspection.key))
        if reads_silhouettes(inspection.model):
            silhouettes.append(silhouette_check(inspection.model, run.session, inspection.frame, inspection.states, inspection.key))
    return Predicted(frames, draws, _stacked(KeypointCheck, keypoints), _stacked(SilhouetteCheck, silhouettes))


def _stacked[Check: tuple[np.ndarray, ...]](kind: Callable[..., Check], checks: list[Check]) -> Check | None:
    return kind(*map(np.stack, zip(*checks, strict=True))) if checks else None


def moment(run: "SavedRun", index: int) -> Moment:
    """Return one frame of the run with its draws."""
    model = seen_in(run.model, run.session, index)
    needed = (model.body.variable, *(name for term in model.unknowns for name in (term.name, *term.reads)))
    names = [name for name in dict.fromkeys(needed) if name in run.tree["posterior"]]
    pieces = {name: next(pose_blocks(run.tree, range(index, index + 1), variable=name)) for name in names}
    weights = pooled(weights_of_runs(pieces[names[0]].log_weights))[0]
    values = {name: pooled(piece.poses)[0] for name, piece in pieces.items()}
    if run.mode_seeker:
        space = {model.body.variable: configuration_space(model.body), **{term.name: term.space for term in model.unknowns}}
        states = {name: np.asarray(space[name].mean(weights[None] / weights.sum(), v[None])) for name, v in values.items() if name in space}
    else:
        chosen = systematic_resampling(np.random.default_rng([RESAMPLING_SEED, index]), weights, DRAWS)
        states = {name: v[chosen] for name, v in values.items()}
    mean = configuration_space(model.body).mean(weights[None] / weights.sum(), values[model.body.variable][None])
    frame = frame_near(model, np.asarray(mean), run.session, read_frame(run.session, index))
    return Moment(model, frame, states, jax.random.fold_in(jax.random.key(RESAMPLING_SEED), index))


def seen_keypoints(moment: Moment, likelihood: KeypointLikelihood) -> Float[np.ndarray, "camera marker 3"]:
    """Return column, row and confidence of the keypoints that a likelihood reads."""
    # Of several candidates, the likeliest one.
    evidence = moment.model.observers[likelihood.name](moment.frame._replace(candidates=None))
    keypoints = np.concatenate([evidence.pixels, evidence.confidence[..., None]], axis=-1)
    return keypoints[:, list(likelihood.markers.places)].astype(float)
