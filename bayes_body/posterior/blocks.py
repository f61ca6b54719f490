"""Read a posterior a few frames at a time, so that memory is bounded for a recording of any length."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

if TYPE_CHECKING:
    import xarray as xr

# The most frames of a block, and the most numbers (8 bytes each) of one of its arrays.
BLOCK, LARGEST = 64, 2**22


class Block(NamedTuple):
    """Some frames of a posterior.

    Attributes:
        frames: numbers of the frames.
        poses: radians and metres, float64.
        log_weights: log-weights, normalised over the draws of a run and frame.
    """

    frames: range
    poses: Float[np.ndarray, "run draw frame dof"]
    log_weights: Float[np.ndarray, "run draw frame"]


def pose_blocks(tree: "xr.DataTree", frames: range | None = None, block: int = BLOCK, width: int | None = None) -> Iterator[Block]:
    """Yield poses and weights, block by block.

    Args:
        tree: a tree made by `to_datatree`, in memory or opened lazily.
        frames: numbers of the frames to read; all by default.
        block: largest number of frames at a time; fewer are read if their arrays would be too large.
        width: how many numbers the caller computes from one draw of one frame; the number of dofs by default.
    """
    pose, log_weight = tree["posterior"]["pose"], tree["sample_stats"]["log_weight"]
    frames = range(pose.sizes["frame"]) if frames is None else frames
    draws = pose.sizes["chain"] * pose.sizes["draw"]
    for piece in pieces(frames, min(block, LARGEST // (draws * (width or pose.sizes["dof"])))):
        places = _slice(piece)
        yield Block(piece, np.asarray(pose.isel(frame=places), float), np.asarray(log_weight.isel(frame=places), float))


def pieces(frames: range, block: int) -> Iterator[range]:
    """Yield the range in pieces of at most `block` (at least one) frames."""
    block = max(block, 1)
    for start in range(0, len(frames), block):
        yield frames[start : start + block]


def _slice(frames: range) -> slice:
    return slice(frames.start, frames.stop, frames.step)


def weights_of_runs(log_weights: Float[np.ndarray, "run draw frame"]) -> Float[np.ndarray, "run draw frame"]:
    """Return weights that sum to one over the draws of each run and frame."""
    weights = np.exp(log_weights - log_weights.max(axis=1, keepdims=True))
    return weights / weights.sum(axis=1, keepdims=True)


def log_mean_exp(values: Float[np.ndarray, " run"]) -> float:
    """Return the logarithm of the mean of estimates that are given by their logarithms; NaN if one is NaN."""
    return float("nan") if np.isnan(values).any() else float(np.logaddexp.reduce(values) - np.log(values.size))


def pooled(values: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return an array (run, draw, frame, ...) as (frame, run and draw, ...)."""
    by_frame = np.moveaxis(values, 2, 0)
    return by_frame.reshape(by_frame.shape[0], -1, *by_frame.shape[3:])
