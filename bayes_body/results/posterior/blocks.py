"""Read a posterior a few frames at a time, so that memory is bounded for a recording of any length.

`stored_spaces` returns the spaces of the stored variables that the diagnostics read.
"""

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from bayes_body.base.errors import input_error
from bayes_body.density.spaces import Space, euclidean, numbered, space_from_text

if TYPE_CHECKING:
    import xarray as xr

# Name of the attribute with a variable's space.
SPACE = "space"
# End of the names of variables that only repeat the frame before.
BEFORE = "_before"


def stored_spaces(tree: "xr.DataTree") -> dict[str, Space]:
    """Return the spaces of the variables that diagnostics read: of `pose` where there is one, else of all variables that do not repeat another frame.

    A posterior without spaces, as older versions wrote it, has plain numbers, with the names and units of its dofs.

    Raises:
        InputError: a space cannot be read.
    """
    group = tree["posterior"].to_dataset()
    names = ["pose"] if "pose" in group else [str(name) for name in group.data_vars if not str(name).endswith(BEFORE)]
    return {name: _space(name, group[name]) for name in names}


def _space(name: str, values: "xr.DataArray") -> Space:
    if SPACE in values.attrs:
        try:
            return space_from_text(str(values.attrs[SPACE]))
        except ValueError as error:
            problem, expected = str(error), "the space of a variable, as this version writes it"
            raise input_error(f"the posterior's variable '{name}'", problem, expected, "read it with the version that wrote it") from None
    dims = [dim for dim in values.dims if dim not in ("chain", "draw", "frame")]
    if len(dims) != 1 or dims[0] not in values.coords:
        return numbered(name, tuple(values.sizes[dim] for dim in dims))
    labels = tuple(np.asarray(values[dims[0]]).astype(str).tolist())
    units = tuple(np.asarray(values["unit"]).astype(str).tolist()) if dims[0] == "dof" and "unit" in values.coords else ("",) * len(labels)
    return euclidean(labels, units, str(dims[0]))


# The most frames of a block, and the most numbers (8 bytes each) of one of its arrays.
BLOCK, LARGEST = 64, 2**22


class Block(NamedTuple):
    """Some frames of a posterior.

    Attributes:
        frames: numbers of the frames.
        poses: values of one variable, such as poses in radians and metres, or coordinates of several; float64.
        log_weights: log-weights, normalised over the draws of a run and frame.
    """

    frames: range
    poses: Float[np.ndarray, "run draw frame *dof"]
    log_weights: Float[np.ndarray, "run draw frame"]


def pose_blocks(
    tree: "xr.DataTree", frames: range | None = None, block: int = BLOCK, width: int | None = None, variable: str = "pose"
) -> Iterator[Block]:
    """Yield poses and weights, block by block.

    Args:
        tree: a tree made by `to_datatree`, in memory or opened lazily.
        frames: numbers of the frames to read; all by default.
        block: largest number of frames at a time; fewer are read if their arrays would be too large.
        width: how many numbers the caller computes from one draw of one frame; the size of a pose by default.
        variable: another variable that is read instead of the poses.
    """
    pose, log_weight = tree["posterior"][variable], tree["sample_stats"]["log_weight"]
    frames = range(pose.sizes["frame"]) if frames is None else frames
    draws = pose.sizes["chain"] * pose.sizes["draw"]
    size = width or pose.size // (draws * pose.sizes["frame"])
    for piece in pieces(frames, min(block, LARGEST // (draws * size))):
        places = _slice(piece)
        yield Block(piece, np.asarray(pose.isel(frame=places), float), np.asarray(log_weight.isel(frame=places), float))


def placing_blocks(
    tree: "xr.DataTree", placing: tuple[str, ...], frames: range | None = None, block: int = BLOCK, width: int | None = None
) -> Iterator[tuple[Block, dict[str, NDArray[np.floating]]]]:
    """Yield the blocks of the variable that places the body, each with the values of the unknowns that change the body, by name.

    Unknowns that the tree does not hold are left out: the body is the subject's then.

    Args:
        tree: as for `pose_blocks`.
        placing: `Model.placing`.
        frames: as for `pose_blocks`.
        block: as for `pose_blocks`.
        width: as for `pose_blocks`.
    """
    variable, *change_names = (name for name in placing if name == placing[0] or name in tree["posterior"])
    width = width or tree["posterior"][variable].isel(chain=0, draw=0, frame=0).size
    by_name = (pose_blocks(tree, frames, block, width, name) for name in (variable, *change_names))
    for first, *changes in zip(*by_name, strict=True):
        yield first, {name: change.poses for name, change in zip(change_names, changes, strict=True)}


def coordinate_blocks(
    tree: "xr.DataTree", frames: range | None = None, block: int = BLOCK, spaces: Mapping[str, Space] | None = None
) -> Iterator[Block]:
    """Yield coordinates and weights, block by block: those of `Space.coordinates` around the pooled mean of each frame, all variables side by side.

    For a pose they are its entries, with angles on the circle on the turn nearest to their mean.

    Args:
        tree: a tree made by `to_datatree`.
        frames: as for `pose_blocks`.
        block: as for `pose_blocks`.
        spaces: the variables and their spaces; by default `stored_spaces(tree)`.
    """
    spaces = stored_spaces(tree) if spaces is None else spaces
    width = sum(space.dimension for space in spaces.values())
    for variable_blocks in zip(*(pose_blocks(tree, frames, block, width, name) for name in spaces), strict=True):
        centred = [around_mean(space, piece.poses, piece.log_weights) for space, piece in zip(spaces.values(), variable_blocks, strict=True)]
        yield Block(variable_blocks[0].frames, np.concatenate(centred, axis=-1), variable_blocks[0].log_weights)


def around_mean(
    space: Space, points: Float[np.ndarray, "run draw frame *shape"], log_weights: Float[np.ndarray, "run draw frame"]
) -> Float[np.ndarray, "run draw frame dimension"]:
    """Return the coordinates of the points around the mean of each frame over all runs, which have the same weight."""
    weights = pooled(weights_of_runs(log_weights)) / len(points)
    return np.asarray(space.coordinates(np.asarray(space.mean(weights, pooled(points))), points))


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
