"""Where the body is in the frames that are shown: the mean of the posterior, or its medoid (results/posterior/central.py), and draws of equal weight.

The draws of a frame are made by systematic resampling over all runs, with the same random offset in every frame. Draws of equal weight are therefore
the same draws in every frame, so that the paths of a smoother stay whole.

The number of frames on a page and the size of their images are limited, so that the page stays small.
"""

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from bayes_body.base.geometry import rotations
from bayes_body.base.shapes import Configuration
from bayes_body.model.body.solids import Body, part_axes, part_transforms, widened
from bayes_body.results.posterior import central_pose
from bayes_body.results.posterior.blocks import pooled, pose_blocks, weights_of_runs
from bayes_body.results.posterior.resampling import RESAMPLING_SEED

if TYPE_CHECKING:
    from bayes_body.results.storage.saved_run import SavedRun


class Pose(NamedTuple):
    """The body in one frame.

    Attributes:
        origins: of the parts of the mean body in the world, metres.
        quaternions: of the parts of the mean body, (w, x, y, z).
        radii: of the mean body's parts as cameras see them (base, tip), metres.
        is_mean: whether that body is the mean; else it is the medoid of the draws.
        draws: the two ends of each part's axis in each draw, metres.
    """

    origins: Float[np.ndarray, "part 3"]
    quaternions: Float[np.ndarray, "part 4"]
    radii: Float[np.ndarray, "part 2"]
    is_mean: bool
    draws: Float[np.ndarray, "draw part 2 3"]


def read_poses(run: "SavedRun", frames: range, draws: int) -> Iterator[Pose]:
    """Yield the body in each frame; a block of frames is in memory at a time.

    Args:
        run: the run, loaded from its folder.
        frames: numbers of the frames.
        draws: number of draws in each frame.

    Raises:
        InputError: the body cannot be used.
    """
    body = run.settled_model.body
    offset = np.random.default_rng(RESAMPLING_SEED).random()
    blocks = pose_blocks(run.tree, frames, variable=body.variable)
    points: Iterator[tuple[np.ndarray, np.ndarray]] = (
        sample for block in blocks for sample in zip(pooled(block.poses), pooled(weights_of_runs(block.log_weights)), strict=True)
    )
    for cloud, weights in points:
        weights = weights / weights.sum()
        central = central_pose(body, cloud, weights)
        rotation, origins, radii = (np.asarray(solid, float) for solid in _solids(body, jnp.asarray(central.pose, body.lengths.dtype)))
        chosen = jnp.asarray(cloud[_resampled(weights, draws, offset)], body.lengths.dtype)
        ends = np.asarray(_axes(body, chosen)) if draws else np.zeros((0, len(origins), 2, 3))
        yield Pose(origins, np.asarray(rotations.from_matrix(rotation)), radii, central.is_mean, ends)


def _resampled(weights: Float[np.ndarray, " draw"], count: int, offset: float) -> Int[np.ndarray, " count"]:
    levels = (np.arange(count) + offset) / max(count, 1)
    return np.minimum(np.searchsorted(np.cumsum(weights), levels), len(weights) - 1)


@jax.jit
def _solids(body: Body, configuration: Configuration) -> tuple[Float[Array, "part 3 3"], Float[Array, "part 3"], Float[Array, "part 2"]]:
    T_world_part = part_transforms(body, configuration)
    return T_world_part.rotation, T_world_part.origin, widened(body, configuration).outline_radii


@jax.jit
def _axes(body: Body, configurations: Float[Array, "draw *shape"]) -> Float[Array, "draw part 2 3"]:
    return jax.vmap(part_axes, (None, 0))(body, configurations)


# Bytes of a page: small enough to be mailed. Of them, for the draws and for the images.
LARGEST, DRAWS, IMAGES = 10_000_000, 4_800_000, 3_800_000
# The most frames.
FRAMES = 300
# Bytes in the page, measured: of a part's axis in a draw, of the mean body and the points of a frame, and of a pixel of an image.
AXIS, FRAME, PIXEL = 20.0, 1500.0, 0.13
# Shortest and longest of an image's longer side, pixels.
SIDES = (96, 400)
# Height / width of a usual image.
SHAPE = 0.7


class Budget(NamedTuple):
    """What is to be shown.

    Attributes:
        axes: number of lines of a frame: draws times parts.
        cameras: number of cameras with images.
    """

    axes: int
    cameras: int

    def step(self, frames: int) -> int:
        """Return the step between the frames that are shown."""
        most = min(FRAMES, int(DRAWS / (FRAME + AXIS * self.axes)))
        return math.ceil(frames / max(most, 1))

    def side(self, frames: int) -> int:
        """Return the longer side of the images, pixels, if so many frames are shown."""
        image_bytes = IMAGES / max(frames * self.cameras, 1)
        return int(min(max(math.sqrt(image_bytes / (PIXEL * SHAPE)), SIDES[0]), SIDES[1]))
