"""Quaternions against closed forms and scipy, their gradients at the zero angle, and the group's measure."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bayes_body.base.geometry import rotations

LIBRARIES = [np.asarray, lambda array: jnp.asarray(array, jnp.float32)]
TOLERANCE = {np.dtype(np.float64): 1e-14, np.dtype(np.float32): 1e-6}


def random_rotations(count=500, seed=1):
    return Rotation.random(count, rng=np.random.default_rng(seed))


def quaternions(rotation: Rotation) -> np.ndarray:
    return rotation.as_quat(canonical=True, scalar_first=True)


def vectors(count=500, seed=2):
    """Rotation vectors of all lengths up to π, many of them near zero and on both sides of the series' limit."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(count, 3))
    length = np.where(np.arange(count) % 2, rng.uniform(0, math.pi - 1e-3, count), 10 ** rng.uniform(-9, 0, count))
    return direction / np.linalg.norm(direction, axis=1, keepdims=True) * length[:, None]


def close(found, expected, factor=1.0):
    np.testing.assert_allclose(found, expected, rtol=0, atol=factor * TOLERANCE[np.dtype(found.dtype)])


@pytest.mark.parametrize("library", LIBRARIES)
class TestAgainstScipy:
    def test_products_and_rotated_vectors(self, library):
        first, second = random_rotations(seed=3), random_rotations(seed=4)
        v = np.random.default_rng(5).normal(size=(500, 3))
        product = rotations.multiply(library(quaternions(first)), library(quaternions(second)))
        close(rotations.canonical(product), quaternions(first * second))
        close(rotations.rotate(library(quaternions(first)), library(v)), first.apply(v), 10)
        close(rotations.rotate(rotations.conjugate(library(quaternions(first))), library(v)), first.inv().apply(v), 10)

    def test_exponential_and_logarithm(self, library):
        w = vectors()
        close(rotations.canonical(rotations.exponential(library(w))), quaternions(Rotation.from_rotvec(w)))
        close(rotations.logarithm(library(quaternions(Rotation.from_rotvec(w)))), w, 10)
        close(rotations.angle(library(quaternions(Rotation.from_rotvec(w)))), np.linalg.norm(w, axis=1), 10)

    def test_the_logarithm_of_small_angles_has_all_digits(self, library):
        w = library(vectors())
        there_and_back = rotations.logarithm(rotations.exponential(w))
        np.testing.assert_allclose(there_and_back, w, rtol=20 * np.finfo(w.dtype).eps, atol=1e-5 if w.dtype == np.float32 else 1e-13)
        tiny = np.linalg.norm(vectors(), axis=1) < 1e-3
        np.testing.assert_allclose(there_and_back[tiny], w[tiny], rtol=20 * np.finfo(w.dtype).eps)

    def test_matrices(self, library):
        rotation = random_rotations()
        close(rotations.to_matrix(library(quaternions(rotation))), rotation.as_matrix(), 2)
        close(rotations.from_matrix(library(rotation.as_matrix())), quaternions(rotation))

    def test_half_turns_keep_their_digits(self, library):
        # Shepperd's method takes another row for each of them; the trace alone gives 0 / 0.
        for axis in [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0.6, 0, 0.8), (-0.48, 0.6, 0.64)]:
            expected = np.array([0.0, *axis]) * np.sign(next(a for a in axis if a))
            matrix = 2 * np.outer(axis, axis) - np.eye(3)
            close(rotations.from_matrix(library(matrix)), expected, 2)
            close(np.asarray(rotations.logarithm(library(expected))), math.pi * expected[1:], 10)

    def test_the_result_has_the_library_and_the_precision_of_the_argument(self, library):
        q = library(quaternions(random_rotations(3)))
        for found in (
            rotations.multiply(q, q),
            rotations.conjugate(q),
            rotations.rotate(q, q[:, 1:]),
            rotations.exponential(q[:, 1:]),
            rotations.logarithm(q),
            rotations.angle(q),
            rotations.log_jacobian(q[:, 1:]),
            rotations.to_matrix(q),
            rotations.from_matrix(rotations.to_matrix(q)),
        ):
            assert isinstance(found, type(q))
            assert found.dtype == q.dtype


def test_both_signs_are_one_rotation():
    q = quaternions(random_rotations())
    for function in (rotations.logarithm, rotations.to_matrix, rotations.canonical, rotations.angle):
        np.testing.assert_array_equal(function(-q), function(q))
    half_turn = np.array([[0.0, -0.6, 0.0, 0.8], [-0.0, 0.0, 0.0, -1.0]])
    np.testing.assert_array_equal(rotations.logarithm(-half_turn), rotations.logarithm(half_turn))


def there_and_back(w):
    return rotations.logarithm(rotations.exponential(w))


def test_gradients_at_the_zero_angle():
    zero, identity = jnp.zeros(3), jnp.asarray(rotations.identity(), jnp.float32)

    @jax.jit
    def slopes(zero, identity, matrix):
        """Of the exponential, the logarithm, its Jacobian twice, the angle, there and back, and of a matrix's quaternion."""
        at_zero = jax.jacrev(rotations.exponential)(zero), jax.grad(rotations.log_jacobian)(zero), jax.hessian(rotations.log_jacobian)(zero)
        at_identity = jax.jacrev(rotations.logarithm)(identity), jax.grad(rotations.angle)(identity)
        return *at_zero, *at_identity, jax.jacrev(there_and_back)(zero), jax.jacrev(rotations.from_matrix)(matrix)

    exponential, jacobian, curvature, logarithm, angle, back, quaternion = slopes(zero, identity, jnp.eye(3))
    np.testing.assert_allclose(exponential, np.eye(4)[:, 1:] / 2, atol=1e-7)
    np.testing.assert_allclose(logarithm, 2 * np.eye(4)[1:], atol=1e-7)
    np.testing.assert_allclose(jacobian, np.zeros(3), atol=1e-7)
    # -|w|² / 12 has the second derivatives -1/6.
    np.testing.assert_allclose(curvature, -np.eye(3) / 6, atol=1e-6)
    assert np.isfinite(angle).all()
    np.testing.assert_allclose(back, np.eye(3), atol=1e-7)
    assert np.isfinite(quaternion).all()


# The values at several vectors and the slope at one, of each function.
COMPILED = [
    (jax.jit(jax.vmap(function)), jax.jit(jax.jacrev(function))) for function in (rotations.exponential, rotations.log_jacobian, there_and_back)
]


@pytest.mark.slow
@pytest.mark.parametrize("length", [1e-20, 1e-4, 0.0999, 0.1001, 1.0, 3.1])
def test_gradients_against_central_differences(length):
    with jax.enable_x64(True):
        w = length * np.array([0.48, -0.6, 0.64])
        step = 1e-6
        moves = step * np.eye(3)
        for values, slopes in COMPILED:
            ahead, behind = (np.asarray(values(w + sign * moves)) for sign in (1, -1))
            np.testing.assert_allclose(slopes(w), np.moveaxis((ahead - behind) / (2 * step), 0, -1), atol=1e-8)


def test_the_matrix_is_differentiated_through_every_row_of_shepperds_method():
    def through_the_matrix(w):
        return rotations.logarithm(rotations.from_matrix(rotations.to_matrix(rotations.exponential(w))))

    with jax.enable_x64(True):
        slope = jax.jit(jax.jacrev(through_the_matrix))
        for w in ([0.1, 0.2, -0.1], [3.0, 0.1, 0.2], [0.1, 3.0, -0.2], [-0.2, 0.1, 3.0]):
            np.testing.assert_allclose(slope(np.array(w)), np.eye(3), atol=1e-9)


def test_log_jacobian_in_closed_form_and_in_single_precision():
    w = vectors()
    length = np.linalg.norm(w, axis=1)
    far = length > 0.05
    expected = np.log(2 * (1 - np.cos(length[far])) / length[far] ** 2)
    np.testing.assert_allclose(rotations.log_jacobian(w)[far], expected, atol=1e-11)
    np.testing.assert_allclose(rotations.log_jacobian(jnp.asarray(w, jnp.float32)), rotations.log_jacobian(w), atol=1e-6)


def test_all_rotations_together_have_the_measure_eight_pi_squared():
    # Gauss-Legendre over the radius of the ball |w| < π: 4 π r² exp(log_jacobian).
    nodes, weights = np.polynomial.legendre.leggauss(30)
    radius = (nodes + 1) * math.pi / 2
    density = np.exp(rotations.log_jacobian(radius[:, None] * np.array([0.0, 0.6, 0.8])))
    total = np.sum(weights * math.pi / 2 * 4 * math.pi * radius**2 * density)
    assert total == pytest.approx(8 * math.pi**2, rel=1e-12)


def test_the_measure_is_that_of_uniform_rotations():
    # Under Haar measure the angle has the density (1 - cos r) / π, and E[1 / jacobian] is the ball's volume over 8 π².
    w = Rotation.random(200_000, rng=np.random.default_rng(6)).as_rotvec()
    inverse = np.exp(-rotations.log_jacobian(w))
    error = inverse.std() / math.sqrt(len(w))
    assert abs(inverse.mean() - (4 / 3 * math.pi**4) / (8 * math.pi**2)) < 4 * error
