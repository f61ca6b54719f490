"""What the draws of a run predict in each camera, against what was seen there, at a few frames: the numbers of the posterior predictive check.

The check uses at most FRAMES frames and DRAWS draws of equal weight, so that its cost does not grow with the run.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from bayes_body.base.errors import InputError, input_error
from bayes_body.base.progress import Watch, unwatched
from bayes_body.model.body.space import configuration_space
from bayes_body.model.build import Model
from bayes_body.recording.observation.frames import Frame, read_frame
from bayes_body.results.metrics.silhouette import seen_in
from bayes_body.results.posterior import markers
from bayes_body.results.posterior.blocks import pooled, pose_blocks, weights_of_runs
from bayes_body.results.posterior.resampling import RESAMPLING_SEED, systematic_resampling
from bayes_body.view.report.predicted_keypoints import KeypointCheck, keypoint_check, marker_likelihood
from bayes_body.view.report.predicted_silhouettes import SilhouetteCheck, reads_silhouettes, silhouette_check

if TYPE_CHECKING:
    from bayes_body.results.storage.saved_run import SavedRun

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
        poses: draws of equal weight of all runs together, radians and metres; for a mode seeker their mean alone.
        key: random key of the noise in this frame.
    """

    model: Model
    frame: Frame
    poses: Float[np.ndarray, "draw *shape"]
    key: jax.Array


def prediction_of(run: "SavedRun", watch: Watch = unwatched) -> Predicted | str:
    """Compare a run with its recording at no more than FRAMES evenly spaced frames. Return a sentence that says why if they cannot be compared.

    Args:
        run: the run.
        watch: wraps the frames to show progress.
    """
    try:
        _check_recording(run)
        if marker_likelihood(run.model) is None and not reads_silhouettes(run.model):
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
        it = moment(run, index)
        draws = len(it.poses)
        if marker_likelihood(it.model) is not None:
            keypoints.append(_keypoints(it))
        if reads_silhouettes(it.model):
            silhouettes.append(silhouette_check(it.model, run.session, it.frame, it.poses, it.key))
    return Predicted(frames, draws, _stacked(KeypointCheck, keypoints), _stacked(SilhouetteCheck, silhouettes))


def _stacked[Check: tuple[np.ndarray, ...]](kind: Callable[..., Check], checks: list[Check]) -> Check | None:
    return kind(*map(np.stack, zip(*checks, strict=True))) if checks else None


def moment(run: "SavedRun", index: int) -> Moment:
    """Return one frame of the run with its draws."""
    model = seen_in(run.model, run.session, index)
    (piece,) = pose_blocks(run.tree, range(index, index + 1), variable=model.body.variable)
    weights, poses = pooled(weights_of_runs(piece.log_weights))[0], pooled(piece.poses)[0]
    if run.mode_seeker:
        drawn = np.asarray(configuration_space(model.body).mean(weights[None] / weights.sum(), poses[None]))
    else:
        drawn = poses[systematic_resampling(np.random.default_rng([RESAMPLING_SEED, index]), weights, DRAWS)]
    key = jax.random.fold_in(jax.random.key(RESAMPLING_SEED), index)
    return Moment(model, read_frame(run.session, index), drawn, key)


def seen_keypoints(it: Moment) -> tuple[Float[np.ndarray, "camera marker 3"], Float[np.ndarray, "draw marker 3"]]:
    """Return column, row and confidence of the keypoints, and the markers that the draws place, metres; for a model that reads keypoints."""
    named_likelihood = marker_likelihood(it.model)
    assert named_likelihood is not None
    name, likelihood = named_likelihood
    evidence = it.model.observers[name](it.frame)
    keypoints = np.concatenate([evidence.pixels, evidence.confidence[..., None]], axis=-1)[:, list(likelihood.places)]
    return keypoints.astype(float), markers(it.model, it.poses.astype(np.float32))[:, list(likelihood.markers)]


def _keypoints(it: Moment) -> KeypointCheck:
    named_likelihood = marker_likelihood(it.model)
    assert named_likelihood is not None
    keypoints, points = seen_keypoints(it)
    return keypoint_check(named_likelihood[1].detections, points, keypoints, it.key)
