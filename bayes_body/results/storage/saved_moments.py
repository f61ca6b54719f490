"""Mean, standard deviation and quantiles of a saved run's markers and joint angles, read from its posterior a block of frames at a time."""

from collections.abc import Callable, Iterator, Mapping

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from bayes_body.base.errors import input_error
from bayes_body.model.body.solids import configuration_space
from bayes_body.results.posterior.blocks import BLOCK, placing_blocks, pooled, pose_blocks, weights_of_runs
from bayes_body.results.posterior.moments import Moments, MomentsAndMedian, moments_in, weighted_moments
from bayes_body.results.posterior.weighted import markers
from bayes_body.results.storage.saved_run import SavedRun

# Number of poses whose markers are computed at a time.
CHUNK = 8192


def marker_moments(run: SavedRun, frames: range | None = None, block: int = BLOCK) -> Moments:
    """Return the moments of the virtual markers, (frame, marker, 3), metres, pooled over the runs, which all have the same weight.

    Args:
        run: the run, loaded from its folder.
        frames: numbers of the frames; all by default.
        block: largest number of frames in memory at a time.

    Raises:
        InputError: the run's body has no virtual markers.
    """
    if not run.model.body.markers.names:
        raise input_error(f"the body '{run.model.body.name}'", "no virtual markers", "at least one", "give the body file a table [markers]")

    moments = []
    for piece, changes in placing_blocks(run.tree, run.model.placing, frames, block, 3 * len(run.model.body.markers.names)):
        weights = pooled(weights_of_runs(piece.log_weights)) / piece.poses.shape[0]
        moments.append(weighted_moments(markers_of_each(run, piece.poses, changes), weights))
    return Moments(*(np.concatenate(parts) for parts in zip(*moments, strict=True)))


def markers_of_each(
    run: SavedRun, poses: Float[np.ndarray, "run draw frame *shape"], changes: Mapping[str, Float[np.ndarray, "run draw frame entry"]]
) -> Float[np.ndarray, "frame pooled marker 3"]:
    """Return the markers of all draws of all runs, metres. Poses and changes are those of `placing_blocks`, or some of their draws."""
    names = tuple(changes)

    def positions(*chunk: Float[np.ndarray, "chunk ..."]) -> NDArray[np.floating]:
        return markers(run.model, chunk[0], **dict(zip(names, chunk[1:], strict=True)))

    return of_each(pooled(poses), positions, *(pooled(changes[name]) for name in names))


def of_each(
    poses: Float[np.ndarray, "frame draw *shape"], function: Callable[..., NDArray[np.floating]], *inputs: Float[np.ndarray, "frame draw entry"]
) -> Float[np.ndarray, "frame draw *of"]:
    """Return a compiled function's values of each configuration, and of `inputs`; it gets CHUNK of them at a time."""
    flat = [values.reshape(-1, *values.shape[2:]) for values in (poses, *inputs)]
    # All pieces have the same shape: a shorter last one would need another compilation.
    count = len(flat[0])
    pieces = [function(*(_padded(values[start : start + CHUNK]) for values in flat)) for start in range(0, count, CHUNK)]
    values = np.concatenate(pieces)[:count]
    return values.reshape(*poses.shape[:2], *values.shape[1:]).astype(float)


def angle_moments(run: SavedRun, frames: range | None = None, block: int = BLOCK) -> Moments:
    """Return the moments of the dofs, (frame, dof), radians and metres, pooled over the runs, which all have the same weight.

    An angle without limits, such as the direction a walker faces, is first brought within half a turn of its circular mean; an angle with limits is
    not changed (`posterior.moments.moments_in`). For a body that is placed by its parts, they are the moments of the parts' coordinates. The
    arguments are those of `marker_moments`.
    """
    space = configuration_space(run.model.body)
    return moments_of(run, frames, block, space.dimension, lambda points, weights: moments_in(space, points, weights))


def mean_configurations(run: SavedRun, frames: range | None = None, block: int = BLOCK) -> Float[np.ndarray, "frame *shape"]:
    """Return the mean of the variable that places the body, in its space: poses (frame, dof), or the transforms of the parts (frame, part, 7).

    The moments of `angle_moments` are those of the coordinates around it. The arguments are those of `marker_moments`.
    """
    space = configuration_space(run.model.body)
    return np.concatenate([np.asarray(space.mean(weights, points)) for points, weights in _pieces(run, frames, block, space.dimension)])


def moments_of[M: (Moments, MomentsAndMedian)](run: SavedRun, frames: range | None, block: int, width: int, statistic: Callable[..., M]) -> M:
    """Return the moments that `statistic` computes from the configurations and weights (frame, draw, ...) of each piece.

    `width` is how many numbers it computes from one draw of one frame. The other arguments are those of `marker_moments`.
    """
    moments = [statistic(points, weights) for points, weights in _pieces(run, frames, block, width)]
    return type(moments[0])(*(np.concatenate(parts) for parts in zip(*moments, strict=True)))


def _pieces(
    run: SavedRun, frames: range | None, block: int, width: int
) -> Iterator[tuple[Float[np.ndarray, "frame draw *shape"], Float[np.ndarray, "frame draw"]]]:
    for piece in pose_blocks(run.tree, frames, block, width, run.model.body.variable):
        yield pooled(piece.poses), pooled(weights_of_runs(piece.log_weights)) / piece.poses.shape[0]


def _padded(poses: Float[np.ndarray, "draw *shape"]) -> Float[np.ndarray, "chunk *shape"]:
    return np.concatenate([poses, np.broadcast_to(poses[-1:], (CHUNK - len(poses), *poses.shape[1:]))])
