"""Log-ratios of pixels: how an observation packs them, and how the likelihood `regions` looks them up.

A map holds, at each pixel, the logarithm of the ratio of two probabilities of what is seen there. It is stored in 255 levels, symmetric about
`NEUTRAL`. Outside an image, and in a camera that did not see the frame, the ratio is exactly 1: a region that nobody sees counts exactly 0. The
packing is that of recording/evidence/silhouette_edges.py.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import NDArray

from bayes_body.base.geometry.camera import Camera, Pixels
from bayes_body.recording.evidence.silhouette_edges import Levels, Lookup, Packed, look_up, quantised

# The order of the maps of a camera.
INSIDE, BAND, EDGES = range(3)
# The value of the log-ratio 0. As a power of two over 255 it is stored without rounding.
NEUTRAL = 128 / 255


class RegionMaps(NamedTuple):
    """For one frame: log-ratios of the foreground inside a part and in the band beside it, and of the edges, packed.

    `nats` is the log-ratio of a map per unit of the value that is looked up.
    """

    log_ratios: Packed
    nats: Float[Array | np.ndarray, " map"]


def quantised_log_ratios(log_ratios: NDArray[np.floating], largest: float, shape: tuple[int, int]) -> Levels:
    """A map (row, column) of log-ratios of at most `largest`, in 8 bits, padded to `shape`, the largest (rows, columns)."""
    return quantised(NEUTRAL + log_ratios * (127 / 255 / largest), NEUTRAL, shape)


def unseen(shape: tuple[int, int]) -> Levels:
    """The map of a camera that did not see the frame."""
    return quantised(np.empty((0, 0), np.float32), NEUTRAL, shape)


def nats_of(largest: float) -> float:
    """The log-ratio per unit of the value that is looked up."""
    return largest * 255 / 127


def log_ratios_at(
    maps: RegionMaps, map_index: Int[Array, " sample"], kind: Lookup, rig: Camera, pixels: Pixels[Float[Array, "camera sample"]]
) -> Float[Array, "camera sample"]:
    """The log-ratios of each camera's maps at its pixels: 0 for a point that is not visible or outside the image.

    Args:
        maps: the maps of a frame.
        map_index: which of a camera's maps each sample reads.
        kind: nearest or bilinear.
        rig: cameras, for their image sizes.
        pixels: where to look up.
    """
    # `look_up` stays just inside the far border, where the value is not exactly neutral.
    inside = pixels.visible & (pixels.u < rig.size[:, :1]) & (pixels.v < rig.size[:, 1:])
    values = look_up(maps.log_ratios, map_index, kind, rig, Pixels(pixels.u[:, None], pixels.v[:, None], inside[:, None]))[:, 0]
    return (values - NEUTRAL) * jnp.asarray(maps.nats)[map_index]
