r"""Responses of orientation-tuned quadrature filters: how the host packs them, and how the device interpolates and steers them.

A filter steered to the direction $\theta$ responds to a frequency of direction $\varphi$ with $\cos^2(\varphi - \theta)$ in its even part and with
$\mathrm{sgn}(\cos)\cos^2(\varphi - \theta)$ in its odd part, truncated after the third harmonic. Both are polynomials of the unit vector
$n = (\cos\theta, \sin\theta)$, so seven maps steer to any direction exactly (Freeman & Adelson 1991):
$$E = e_0 + e_c \cos 2\theta + e_s \sin 2\theta, \qquad
O = o_{1c} \cos\theta + o_{1s} \sin\theta + o_{3c} \cos 3\theta + o_{3s} \sin 3\theta.$$

Responses are interpolated bilinearly. Phase and amplitude of $E + iO$ are computed afterwards, because they cannot be interpolated where they wrap.

A pixel's seven numbers are adjacent, 16 bits each, two per word: a look-up reads four words at each of four pixels.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt32
from numpy.typing import NDArray

from bayes_body.base.geometry.camera import Camera, Pixels

# Harmonics 1 and 3 of sgn(cos) cos²; the higher ones are 3 % of it.
ODD = (8 / (3 * np.pi), 8 / (15 * np.pi))
EVEN_MAPS, ODD_MAPS = 3, 4
WORDS = 4
_LARGEST = 32767

type Packed = UInt32[Array | np.ndarray, "camera scale row column word"]
type Samples = Float[Array, "camera part sample"]


class PhaseMaps(NamedTuple):
    """The responses in one frame: packed numbers, the grey levels per step of 16 bits, and which cameras saw the frame (1, else 0)."""

    responses: Packed
    level: Float[Array | np.ndarray, "camera scale"]
    has_image: Float[Array | np.ndarray, " camera"]


class Response(NamedTuple):
    """The even and the odd part of a steered filter, grey levels."""

    even: Any
    odd: Any


def pack(maps: NDArray[np.floating], shape: tuple[int, int]) -> tuple[NDArray[np.uint32], np.float32]:
    """Pack the seven maps (map, row, column) of a scale into words (row, column, word) padded to `shape`, (rows, columns). Also levels per step."""
    level = max(float(np.abs(maps).max()), 1e-6) / _LARGEST
    _, rows, columns = maps.shape
    halves = np.zeros((*shape, 2 * WORDS), np.int16)
    halves[:rows, :columns, : len(maps)] = np.rint(maps / level).transpose(1, 2, 0)
    return halves.view("<u4").astype(np.uint32, copy=False), np.float32(level)


def unseen(shape: tuple[int, int]) -> NDArray[np.uint32]:
    """The words of a camera that saw nothing."""
    return np.zeros((*shape, WORDS), np.uint32)


def look_up(maps: PhaseMaps, rig: Camera, pixels: Pixels[Samples], normals: tuple[Samples, Samples]) -> Response:
    """The responses at pixels, steered along unit vectors (column, row). Outside an image the nearest pixel counts.

    Args:
        maps: the responses in a frame.
        rig: cameras, for their image sizes.
        pixels: where to interpolate.
        normals: the boundary's normals, in the image.
    """
    return steer(_interpolated(maps, rig, pixels.u, pixels.v), *normals)


def steer(values: Any, c: Any, s: Any) -> Response:
    """Seven responses steered along unit vectors with the components c (column) and s (row); any arrays of one shape."""
    cos2, sin2 = c * c - s * s, 2 * c * s
    cos3, sin3 = c * cos2 - s * sin2, s * cos2 + c * sin2
    even = values[0] + cos2 * values[1] + sin2 * values[2]
    odd = c * values[3] + s * values[4] + cos3 * values[5] + sin3 * values[6]
    return Response(even, odd)


def _interpolated(maps: PhaseMaps, rig: Camera, u: Samples, v: Samples) -> list[Float[Array, "scale camera part sample"]]:
    """The seven responses of all scales, interpolated."""
    cameras, scales, rows, columns, _ = maps.responses.shape
    # Stay just inside the far edge, so that the pixels to the right and below exist.
    inset = 1e-3
    u = jnp.clip(u, 0, rig.size[:, 0, None, None] - 1 - inset)
    v = jnp.clip(v, 0, rig.size[:, 1, None, None] - 1 - inset)
    # Without the barrier XLA would repeat the projection for each value derived from u and v.
    u, v = jax.lax.optimization_barrier((u, v))
    column, row = jnp.floor(u), jnp.floor(v)
    a, b = u - column, v - row
    image = (jnp.arange(cameras, dtype=jnp.int32) * scales)[:, None, None] + jnp.arange(scales, dtype=jnp.int32)[:, None, None, None]
    first = (image * rows + row.astype(jnp.int32)) * columns + column.astype(jnp.int32)
    index = jax.lax.optimization_barrier(jnp.stack([first, first + 1, first + columns, first + columns + 1]))
    # Barriers on both sides: a fused gather would run its producers once per lane, and its consumers unvectorised.
    words = jax.lax.optimization_barrier(jnp.asarray(maps.responses).reshape(-1, WORDS).at[index].get(mode="promise_in_bounds"))
    weights = ((1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b)
    level = jnp.asarray(maps.level).T[:, :, None, None].astype(u.dtype)
    responses = []
    signed = jax.lax.bitcast_convert_type(words, jnp.int32)
    for number in range(EVEN_MAPS + ODD_MAPS):
        half = signed[..., number // 2]
        # The upper half of a word carries its own sign; the lower half is shifted up for its sign.
        half = half >> 16 if number % 2 else (half << 16) >> 16
        corners = half.astype(u.dtype)
        responses.append(level * sum(weight * corner for weight, corner in zip(weights, corners, strict=True)))
    return responses
