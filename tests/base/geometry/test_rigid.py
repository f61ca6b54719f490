"""Rigid transforms as 7-vectors against homogeneous matrices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bayes_body.base.geometry import rigid, transforms


@pytest.fixture
def x64():
    """Double precision."""
    with jax.enable_x64(True):
        yield


def random_rigid(seed, count=50) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.concatenate([rng.normal(size=(count, 3)), Rotation.random(count, rng=rng).as_quat(canonical=True, scalar_first=True)], axis=1)


def matrices(X) -> np.ndarray:
    out = np.tile(np.eye(4), (len(X), 1, 1))
    out[:, :3, :3] = Rotation.from_quat(np.asarray(X)[:, 3:], scalar_first=True).as_matrix()
    out[:, :3, 3] = np.asarray(X)[:, :3]
    return out


def test_group_operations_are_those_of_homogeneous_matrices():
    X, Y = random_rigid(1), random_rigid(2)
    np.testing.assert_allclose(matrices(rigid.compose(X, Y)), matrices(X) @ matrices(Y), atol=1e-14)
    np.testing.assert_allclose(matrices(rigid.inverse(X)), np.linalg.inv(matrices(X)), atol=1e-14)
    np.testing.assert_allclose(matrices(rigid.relative(X, Y)), np.linalg.inv(matrices(X)) @ matrices(Y), atol=1e-14)
    np.testing.assert_allclose(matrices(rigid.compose(X, rigid.identity())), matrices(X), atol=1e-15)


def test_points_move_as_by_homogeneous_matrices():
    X, p = random_rigid(1), np.random.default_rng(3).normal(size=(50, 3))
    expected = np.einsum("nij,nj->ni", matrices(X), np.concatenate([p, np.ones((50, 1))], axis=1))[:, :3]
    np.testing.assert_allclose(rigid.apply(X, p), expected, atol=1e-14)


def test_relative_does_not_change_under_a_common_motion():
    X, Y, Z = random_rigid(1), random_rigid(2), random_rigid(3)
    np.testing.assert_allclose(rigid.relative(rigid.compose(Z, X), rigid.compose(Z, Y)), rigid.relative(X, Y), atol=1e-14)


def test_there_and_back_through_a_transform(x64):
    X = jnp.asarray(random_rigid(1))
    T = rigid.to_transform(X)
    np.testing.assert_allclose(transforms.matrix(T), matrices(X), atol=1e-14)
    np.testing.assert_allclose(rigid.from_transform(T), X, atol=1e-14)


def test_one_transform_against_many():
    X, Y = random_rigid(1), random_rigid(2)
    np.testing.assert_array_equal(rigid.relative(X[0], Y)[7], rigid.relative(X[0], Y[7]))
    np.testing.assert_array_equal(rigid.compose(X[:, None], Y[None])[3, 4], rigid.compose(X[3], Y[4]))


def test_single_precision_inside_vmap():
    X, Y = random_rigid(1), random_rigid(2)
    found = jax.jit(jax.vmap(rigid.compose))(jnp.asarray(X, jnp.float32), jnp.asarray(Y, jnp.float32))
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, rigid.compose(X, Y), atol=2e-6)
