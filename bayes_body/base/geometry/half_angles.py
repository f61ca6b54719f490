r"""The angles between all pairs of rotations at once, from one product of matrices.

With the scalar product w of two unit quaternions, the angle between them is $\theta = 2 \arccos |w|$. With $s = \theta / \sqrt{1 - w^2}$,

$$\theta^2 = s^2 (1 - w^2), \qquad \log \frac{2 (1 - \cos \theta)}{\theta^2} = 2 \log 2 - 2 \log s.$$

s² and 2 log s are polynomials of 1 - |w|, up to the rounding of float32.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.polynomial import polynomial

DEGREE = 8


def _polynomials() -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the coefficients of s² and 2 log s as polynomials of 1 - |w|, by least squares at Chebyshev nodes."""
    w = np.cos(np.linspace(0, np.pi / 2, 4001))
    sine = np.sqrt(1 - w * w)
    s = np.where(sine < 1e-6, 2.0, 2 * np.arctan2(sine, w) / np.where(sine < 1e-6, 1.0, sine))
    square, log = polynomial.polyfit(1 - w, s**2, DEGREE), polynomial.polyfit(1 - w, 2 * np.log(s), DEGREE)
    return tuple(square.tolist()), tuple(log.tolist())


SQUARE, LOG = _polynomials()


def away(first: Float[Array, "first 4"], second: Float[Array, "second 4"]) -> Float[Array, "first second"]:
    """Return 1 - |w| for all pairs of unit quaternions."""
    return 1 - jnp.minimum(jnp.abs(first @ second.T), 1.0)


def squared(versine: Array) -> Array:
    """Return s²."""
    return _horner(SQUARE, versine)


def log_squared(versine: Array) -> Array:
    """Return 2 log s."""
    return _horner(LOG, versine)


def _horner(coefficients: tuple[float, ...], x: Array) -> Array:
    value = jnp.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        value = value * x + coefficient
    return value
