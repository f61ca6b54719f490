r"""Rotations as unit quaternions (w, x, y, z), batched over leading axes, for JAX and NumPy arrays.

`q` and `-q` are the same rotation. Gradients are finite everywhere, also at the zero angle, where the formulas are Taylor series in the square. The
group's measure (Haar) equals Lebesgue measure dw of the rotation vector w at the identity. All rotations together then have the measure $8 \pi^2$.

Source of the formulas: Solà, Deray & Atchuthan 2018, A micro Lie theory for state estimation in robotics; Shepperd 1978, Quaternion from rotation
matrix.

The angles between all pairs of rotations are computed at once, from one product of matrices. With the scalar product w of two unit quaternions, the
angle between them is $\theta = 2 \arccos |w|$. With $s = \theta / \sqrt{1 - w^2}$,

$$\theta^2 = s^2 (1 - w^2), \qquad \log \frac{2 (1 - \cos \theta)}{\theta^2} = 2 \log 2 - 2 \log s.$$

s² and 2 log s are polynomials of 1 - |w|, up to the rounding of float32.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.polynomial import polynomial

from bayes_body.base.geometry.namespaces import namespace

type Quaternion = Float[Array | np.ndarray, "*#batch 4"]
type Vector = Float[Array | np.ndarray, "*#batch 3"]
type Matrix = Float[Array | np.ndarray, "*#batch 3 3"]
type Numbers = Float[Array | np.ndarray, "*#batch"]

# Below these squares (rad², and of the tangent of half the angle) the series are exact to the last digit of double precision.
SMALL_ANGLE, SMALL_TANGENT = 1e-2, 1e-3


def identity(dtype: Any = float) -> Float[np.ndarray, "4"]:
    """Return the rotation that turns nothing."""
    return np.array([1, 0, 0, 0], dtype)


def multiply(q_a_b: Quaternion, q_b_c: Quaternion) -> Quaternion:
    """Return `q_a_c`."""
    w, x, y, z = _entries(q_a_b)
    ow, ox, oy, oz = _entries(q_b_c)
    return namespace(q_a_b, q_b_c).stack(
        [
            w * ow - x * ox - y * oy - z * oz,
            w * ox + x * ow + y * oz - z * oy,
            w * oy - x * oz + y * ow + z * ox,
            w * oz + x * oy - y * ox + z * ow,
        ],
        axis=-1,
    )


def conjugate(q_a_b: Quaternion) -> Quaternion:
    """Return `q_b_a`, the inverse rotation."""
    return q_a_b * np.array([1, -1, -1, -1], q_a_b.dtype)


def rotate(q_a_b: Quaternion, v_b: Vector) -> Vector:
    """Rotate the vectors `v_b` from frame b to frame a."""
    xp = namespace(q_a_b, v_b)
    axis = q_a_b[..., 1:]
    normal = 2 * _cross(xp, axis, v_b)
    return v_b + q_a_b[..., :1] * normal + _cross(xp, axis, normal)


def exponential(w: Vector) -> Quaternion:
    """Return the rotation about the axis w by the angle |w|, radians."""
    xp = namespace(w)
    square = _square(w)
    small, safe = _split(xp, square, SMALL_ANGLE)
    half = xp.sqrt(safe) / 2
    cosine = xp.where(small, 1 - square / 8 * (1 - square / 48 * (1 - square / 120 * (1 - square / 224))), xp.cos(half))
    sine_over_angle = xp.where(small, (1 - square / 24 * (1 - square / 80 * (1 - square / 168))) / 2, xp.sin(half) / (2 * half))
    return xp.concatenate([cosine[..., None], sine_over_angle[..., None] * w], axis=-1)


def logarithm(q: Quaternion) -> Vector:
    """Return the rotation vector, radians, of length π at most; the same for `q` and `-q`."""
    xp = namespace(q)
    q = canonical(q)
    w, v = q[..., 0], q[..., 1:]
    square = _square(v)
    # The half angle's tangent is |v| / w; w is far from zero where the series is taken.
    small = square < SMALL_TANGENT * w * w
    ratio = xp.where(small, square, 0.0) / xp.where(small, w * w, 1.0)
    series = 2 * (1 - ratio * (1 / 3 - ratio * (1 / 5 - ratio * (1 / 7 - ratio / 9)))) / xp.where(small, w, 1.0)
    length = xp.sqrt(xp.where(small, 1.0, square))
    return xp.where(small, series, 2 * xp.arctan2(length, w) / length)[..., None] * v


def canonical(q: Quaternion) -> Quaternion:
    """Return that of `q` and `-q` whose first entry other than zero is positive."""
    xp = namespace(q)
    w, x, y, z = _entries(q)
    first = xp.where(w != 0, w, xp.where(x != 0, x, xp.where(y != 0, y, z)))
    return xp.where(first[..., None] < 0, -q, q)


def normalised(q: Quaternion) -> Quaternion:
    """Return `q` scaled to length one, against the drift of many products; `q` must not be zero."""
    return q / namespace(q).sqrt(_square(q))[..., None]


def angle(q: Quaternion) -> Numbers:
    """Return the angle of the rotation, radians, from 0 to π."""
    xp = namespace(q)
    w, square = xp.abs(q[..., 0]), _square(q[..., 1:])
    turns, safe = square > 0, xp.where(square > 0, square, 1.0)
    return xp.where(turns, 2 * xp.arctan2(xp.sqrt(safe), w), 0.0)


def log_jacobian(w: Vector) -> Numbers:
    r"""Return $\log \big(2 (1 - \cos |w|) / |w|^2\big)$, the logarithm of the Haar measure of $\exp(w)$ relative to Lebesgue measure dw.

    A density p(R) with respect to Haar measure is the density p(exp(w)) exp(log_jacobian(w)) of the rotation vector, |w| < π.
    """
    xp = namespace(w)
    square = _square(w)
    small, safe = _split(xp, square, SMALL_ANGLE)
    half = xp.sqrt(safe) / 2
    series = -square / 12 * (1 + square / 120 * (1 + square * (2 / 126) * (1 + square * (3 / 160))))
    return xp.where(small, series, 2 * xp.log(xp.abs(xp.sin(half)) / half))


def to_matrix(q_a_b: Quaternion) -> Matrix:
    """Return the rotation matrix of a unit quaternion; its columns are b's axes in frame a."""
    xp = namespace(q_a_b)
    w, x, y, z = _entries(q_a_b)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)


def from_matrix(R_a_b: Matrix) -> Quaternion:
    """Return the unit quaternion of a rotation matrix, by Shepperd's method, with the sign of `canonical`."""
    xp = namespace(R_a_b)
    (a, b, c), (d, e, f), (g, h, i) = ([R_a_b[..., row, column] for column in range(3)] for row in range(3))
    # The matrix 4 q qᵀ is linear in R. Its row with the largest diagonal entry, far from zero, has the direction of q.
    rows = [
        [1 + a + e + i, h - f, c - g, d - b],
        [h - f, 1 + a - e - i, d + b, c + g],
        [c - g, d + b, 1 - a + e - i, f + h],
        [d - b, c + g, f + h, 1 - a - e + i],
    ]
    outer = xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)
    largest = xp.argmax(xp.stack([rows[k][k] for k in range(4)], axis=-1), axis=-1)
    return canonical(normalised(xp.take_along_axis(outer, largest[..., None, None], axis=-2)[..., 0, :]))


def _entries(q: Quaternion) -> tuple[Any, ...]:
    return q[..., 0], q[..., 1], q[..., 2], q[..., 3]


def _square(v: Any) -> Any:
    """Return the squared length over the last axis, elementwise (see `transforms`)."""
    return sum(v[..., k] * v[..., k] for k in range(v.shape[-1]))


def _cross(xp: Any, a: Vector, b: Vector) -> Vector:
    a0, a1, a2 = a[..., 0], a[..., 1], a[..., 2]
    b0, b1, b2 = b[..., 0], b[..., 1], b[..., 2]
    return xp.stack([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0], axis=-1)


def _split(xp: Any, square: Any, limit: float) -> tuple[Any, Any]:
    """Return where a series is taken, and the squares with 1 there, so that the branch that is not taken has a finite gradient."""
    small = square < limit
    return small, xp.where(small, 1.0, square)


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
