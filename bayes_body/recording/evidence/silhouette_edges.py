"""Image maps: how the host packs them, and how the device looks values up, nearest or bilinear.

A map is *packed*: each 32-bit word holds a pixel's value and those of its right, lower and lower-right neighbours, 8 bits each. A bilinear look-up is
then one memory access instead of four, and on a CPU memory accesses dominate (docs/decisions). A border of one pixel around the image holds the value
for "not seen". A point outside is moved onto the border, so no sample needs a test, and the density is continuous.
"""

from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8, UInt32
from numpy.typing import NDArray

from bayes_body.base.geometry.camera import Camera, Pixels

type Lookup = Literal["nearest", "bilinear"]
# Levels have a row and a column more than words.
type Levels = UInt8[np.ndarray, "*maps level_row level_column"]
type Packed = UInt32[Array | np.ndarray, "*maps row column"]

BORDER = 1
_OUTSIDE = -9.0

# The order of the two maps of a camera in SilhouetteEdgeMaps.
SILHOUETTE, EDGES = 0, 1
# The fraction of foreground for a camera without a silhouette.
UNSEEN_SHARE = -1.0


class SilhouetteEdgeMaps(NamedTuple):
    """For one frame: the error maps (1 − V)² of silhouette and edges, packed, and the fraction of foreground pixels of each silhouette.

    `points` are pixels of each silhouette, column and row relative to the image's centre, for the likelihood's term "cover"; empty if it is not used.
    A camera that did not see the frame has the same error everywhere, and the fraction `UNSEEN_SHARE`. Where other people cover images, `foreground`
    is the fraction of what they do not cover, and `uncovered` the fraction of each cell that they do not, on the grid on which the body's area is
    measured; None where no camera sees other people, or no area is measured.
    """

    errors: Packed
    foreground: Float[Array | np.ndarray, " camera"]
    points: Float[Array | np.ndarray, "camera point 2"]
    uncovered: Float[Array | np.ndarray, "camera row column"] | None = None


def quantised(
    values: NDArray[np.floating], outside: float, shape: tuple[int, int], corner: tuple[int, int] = (0, 0), size: tuple[int, ...] | None = None
) -> Levels:
    """A map (row, column) of values in [0, 1], in 8 bits, with a border of `outside`, padded with it to `shape`, the largest (rows, columns).

    If the values are only those of a part of an image of `size` (rows, columns), which begins at `corner`, the others are 1.
    """
    levels = np.full([extent + 2 * BORDER + 1 for extent in shape], round(outside * 255), np.uint8)
    image = levels[tuple(slice(BORDER, BORDER + extent) for extent in size or values.shape)]
    if size is not None:
        image[...] = 255
    scaled = np.clip(values, 0, 1) * 255
    scaled += 0.5
    image[tuple(slice(first, first + extent) for first, extent in zip(corner, values.shape, strict=True))] = scaled
    return levels


def hide(levels: Levels, covered: NDArray[np.bool_] | None, outside: float) -> Levels:
    """Give the covered pixels (row, column) of an image's maps the value of what is not seen, in place."""
    if covered is not None:
        rows, columns = covered.shape
        levels[..., BORDER : BORDER + rows, BORDER : BORDER + columns][..., covered] = round(outside * 255)
    return levels


def pack(levels: Levels) -> Packed:
    """Pack the levels of a stack of maps, on the default device: only a quarter of the bytes goes there."""
    return _words(levels)


@jax.jit
def _words(levels: Array) -> Array:
    words = levels.astype(jnp.uint32)
    pairs = words[..., :-1] | (words[..., 1:] << 8)
    return pairs[..., :-1, :] | (pairs[..., 1:, :] << 16)


def look_up(
    maps: Packed, map_index: Int[Array, " sample"], kind: Lookup, rig: Camera, pixels: Pixels[Float[Array, "camera part sample"]]
) -> Float[Array, "camera part sample"]:
    """The values, in [0, 1], of each camera's maps at its pixels. A point that is not visible or outside the image gets the border's value.

    Args:
        maps: packed maps of every camera.
        map_index: which of a camera's maps each sample reads.
        kind: nearest or bilinear.
        rig: cameras, for their image sizes.
        pixels: where to look up.
    """
    width, height = (rig.size[:, i, None, None] for i in (0, 1))
    u = jnp.where(pixels.visible, pixels.u, _OUTSIDE) + BORDER
    v = pixels.v + BORDER
    words = jnp.asarray(maps).reshape(-1)
    cameras, kinds, rows, columns = maps.shape
    first = (jnp.arange(cameras, dtype=jnp.int32)[:, None, None] * kinds + map_index) * (rows * columns)
    if kind == "nearest":
        return _nearest(words, first, columns, jnp.clip(u, 0, width + BORDER), jnp.clip(v, 0, height + BORDER))
    # Stay just inside the border's far edge, so that the pixels to the right and below exist.
    inset = 1e-3
    u, v = jnp.clip(u, 0, width + BORDER - inset), jnp.clip(v, 0, height + BORDER - inset)
    # Without the barrier XLA would repeat the projection for each value derived from u and v.
    u, v = jax.lax.optimization_barrier((u, v))
    return _bilinear(columns, words, first, u, v)


def _gather(words: UInt32[Array, " word"], index: Array) -> Array:
    # Barriers on both sides: a fused gather would run its producers once per lane, and its consumers unvectorised.
    index = jax.lax.optimization_barrier(index)
    return jax.lax.optimization_barrier(words.at[index].get(mode="promise_in_bounds"))


def _nearest(words: UInt32[Array, " word"], first: Int[Array, "camera 1 sample"], columns: int, u: Array, v: Array) -> Array:
    index = first + (v + 0.5).astype(jnp.int32) * columns + (u + 0.5).astype(jnp.int32)
    return (_gather(words, index) & 255).astype(jnp.int32).astype(u.dtype) * (1 / 255)


def _interpolate(words: UInt32[Array, " word"], first: Int[Array, "camera 1 sample"], columns: int, u: Array, v: Array) -> tuple[Array, Array, Array]:
    """The bilinear value and its derivatives along u and v."""
    column, row = jnp.floor(u), jnp.floor(v)
    a, b = u - column, v - row
    index, a, b = jax.lax.optimization_barrier((first + row.astype(jnp.int32) * columns + column.astype(jnp.int32), a, b))
    word = _gather(words, index)
    m00, m01, m10, m11 = (((word >> shift) & 255).astype(jnp.int32).astype(u.dtype) * (1 / 255) for shift in (0, 8, 16, 24))
    above, below = m01 - m00, m11 - m10
    top, bottom = m00 + a * above, m10 + a * below
    return top + b * (bottom - top), above + b * (below - above), bottom - top


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _bilinear(columns: int, words: UInt32[Array, " word"], first: Int[Array, "camera 1 sample"], u: Array, v: Array) -> Array:
    return _interpolate(words, first, columns, u, v)[0]


@_bilinear.defjvp
def _bilinear_jvp(columns: int, primals: tuple[Array, ...], tangents: tuple[Any, ...]) -> tuple[Array, Array]:
    # The tangents of the integer words and offsets have a special type and carry nothing.
    words, first, u, v = primals
    value, along_u, along_v = _interpolate(words, first, columns, u, v)
    return value, along_u * tangents[2] + along_v * tangents[3]
