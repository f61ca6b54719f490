"""Spaces: closed forms, tangent vectors there and back, means, and what names and text keep."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bayes_body.base.geometry import rigid, rotations
from bayes_body.density.spaces import SE3, SO3, Plate, Product, Space, box, circle, euclidean, numbered, space_from_text, space_to_text

DEG = math.pi / 180
PARTS = Plate(("torso", "head"), SE3("coordinate"), "part")
MIXED = Product(("", "", "", "wrist"), (euclidean(("x", "y"), ("m", "m")), circle(("yaw",)), box(("knee",), ("rad",), (0.0,), (2.0,)), SO3()), "dof")
SPACES = {
    "euclidean": euclidean(("a", "b", "c"), ("m", "m", "m")),
    "circle": circle(("yaw", "roll")),
    "box": box(("a", "b"), ("rad", "rad"), (-50.0, -50.0), (50.0, math.inf)),
    "matrix": numbered("w", (2, 3)),
    "scalar": numbered("w", ()),
    "SO3": SO3(),
    "SE3": SE3(),
    "product": MIXED,
    "plate": PARTS,
    "plate of plates": Plate(("left", "right"), PARTS),
    "plate of products": Plate(("left", "right"), MIXED),
}


def origin(space: Space) -> np.ndarray:
    """A point of each space."""
    if isinstance(space, SO3):
        return rotations.identity()
    if isinstance(space, SE3):
        return rigid.identity()
    if isinstance(space, Product):
        return np.concatenate([origin(piece) for piece in space.pieces])
    if isinstance(space, Plate):
        return np.stack([origin(space.space)] * len(space.names))
    return np.full(space.shape, 1.0)


def cloud(space: Space, count: int, spread: float, seed: int = 1) -> np.ndarray:
    """Points about a common one, which is not the origin."""
    rng = np.random.default_rng(seed)
    centre = np.asarray(space.retract(origin(space), rng.normal(size=space.dimension) * 0.3))
    return space.retract(centre, spread * rng.normal(size=(count, space.dimension)))


@pytest.mark.parametrize("name", SPACES)
class TestEverySpace:
    def test_shapes_and_names_agree(self, name):
        space = SPACES[name]
        assert isinstance(space, Space) and hash(space) == hash(SPACES[name])
        points = cloud(space, 5, 0.1)
        assert points.shape == (5, *space.shape) and space.local(points[:1], points).shape == (5, space.dimension)
        assert len(space.tangent_labels) == len(space.tangent_units) == space.dimension == len(set(space.tangent_labels))
        assert len(space.blocks) == math.prod(space.shape) and sorted(set(space.blocks)) == list(range(max(space.blocks) + 1))
        assert len(space.axes) == len(space.shape)
        for axis, size in zip(space.axes, space.shape, strict=True):
            assert len(axis.labels) in (0, size) and len(axis.units) in (0, size)

    def test_retract_and_local_are_inverse(self, name):
        space = SPACES[name]
        x, y = cloud(space, 40, 0.3), cloud(space, 40, 0.3, seed=2)
        v = space.local(x, y)
        np.testing.assert_allclose(space.local(x, space.retract(x, v)), v, atol=1e-12)
        np.testing.assert_allclose(space.distance(space.retract(x, v), y), 0, atol=1e-7)
        np.testing.assert_allclose(space.local(x, x), 0, atol=1e-15)

    def test_distances_are_symmetric(self, name):
        space = SPACES[name]
        x, y = cloud(space, 40, 0.8), cloud(space, 40, 0.8, seed=2)
        np.testing.assert_allclose(space.distance(x, y), space.distance(y, x), atol=1e-12)
        np.testing.assert_allclose(space.distance(x, y), np.linalg.norm(space.local(x, y), axis=-1), atol=1e-12)

    def test_the_mean_of_symmetric_points_is_their_centre(self, name):
        space = SPACES[name]
        centre, v = cloud(space, 1, 0.0), np.random.default_rng(3).uniform(-0.7, 0.7, size=(6, space.dimension))
        points = space.retract(centre, np.concatenate([v, -v]))
        assert np.all(space.distance(np.asarray(space.mean(np.full(12, 1 / 12), points)), centre) < 1e-9)

    def test_the_mean_is_where_the_weighted_tangent_vectors_cancel(self, name):
        space = SPACES[name]
        points, weights = cloud(space, 30, 0.2), np.random.default_rng(4).dirichlet(np.ones(30))
        mean = space.mean(weights, points)
        np.testing.assert_allclose(weights @ space.local(mean, points), 0, atol=1e-9)
        np.testing.assert_allclose(weights @ space.coordinates(mean, points), space.coordinates(mean, mean), atol=1e-9)

    def test_leading_axes_are_vectorised(self, name):
        space = SPACES[name]
        points = cloud(space, 24, 0.3).reshape(2, 3, 4, *space.shape)
        weights = np.random.default_rng(5).dirichlet(np.ones(4), size=(2, 3))
        means = space.mean(weights, points)
        around = space.coordinates(means[:, :, None], points)
        assert means.shape == (2, 3, *space.shape) and around.shape == (2, 3, 4, space.dimension)
        np.testing.assert_allclose(means[1, 2], space.mean(weights[1, 2], points[1, 2]), atol=1e-14)
        np.testing.assert_allclose(around[1, 2, 3], space.coordinates(means[1:2, 2], points[1:2, 2, 3])[0], atol=1e-14)

    def test_text_keeps_everything(self, name):
        assert space_from_text(space_to_text(SPACES[name])) == SPACES[name]


# Rigid transforms and products hold rotations, and plates are spaces one by one.
COMPILED = [pytest.param(name, marks=pytest.mark.slow if name in ("SO3", "product") or name.startswith("plate") else ()) for name in SPACES]


@pytest.mark.parametrize("name", COMPILED)
def test_the_device_computes_what_the_host_computes(name):
    space = SPACES[name]
    points, weights = cloud(space, 8, 0.3), np.full(8, 1 / 8)
    single = jnp.asarray(points, jnp.float32)
    v = jnp.asarray(0.1 * np.random.default_rng(6).normal(size=(8, space.dimension)), jnp.float32)

    @jax.jit
    def computed(points, v):
        moved = jax.vmap(space.retract)(points, v)
        gradient = jax.grad(lambda v: jnp.sum(space.distance(points, jax.vmap(space.retract)(points, v))))(0 * v)
        return moved, jax.vmap(space.local)(points, moved), space.mean(jnp.asarray(weights, jnp.float32), points), gradient

    moved, back, mean, gradient = computed(single, v)
    assert moved.dtype == back.dtype == mean.dtype == jnp.float32
    np.testing.assert_allclose(back, v, atol=2e-5)
    assert np.max(space.distance(np.asarray(mean, float), space.mean(weights, points))) < 1e-5
    assert np.isfinite(gradient).all()


def test_angles_are_averaged_the_short_way_round():
    space = circle(("yaw",))
    weights = np.array([0.5, 0.5])
    across = space.mean(weights, np.array([[179.0], [-179.0]]) * DEG)
    assert abs(np.cos(across[0]) + 1) < 1e-12
    np.testing.assert_allclose(np.abs(space.local(np.array([179.0]) * DEG, np.array([-179.0]) * DEG)), 2 * DEG)
    # The mean takes the turn nearest to the arithmetic one, and without a turn among the draws it is the arithmetic one.
    np.testing.assert_allclose(space.mean(weights, np.array([[725.0], [715.0]]) * DEG), 720 * DEG)
    near = np.random.default_rng(0).normal(2.9, 0.3, size=(100, 1))
    np.testing.assert_array_equal(space.mean(np.full(100, 0.01), near), np.einsum("s,sk->k", np.full(100, 0.01), near))


def test_coordinates_of_numbers_are_the_numbers_to_the_last_bit():
    pose = Product(("", ""), (euclidean(("x",), ("m",)), circle(("yaw",))))
    values = np.random.default_rng(0).normal(size=(50, 2))
    np.testing.assert_array_equal(pose.coordinates(np.zeros(2), values), values)


def test_limits_hold():
    space = SPACES["box"]
    np.testing.assert_array_equal(space.retract(np.array([49.0, 49.0]), np.array([5.0, 5.0])), [50.0, 54.0])


def test_distances_do_not_change_when_the_world_moves():
    moved = cloud(SE3(), 1, 1.0, seed=9)[0]
    x, y = cloud(SE3(), 30, 0.8), cloud(SE3(), 30, 0.8, seed=2)
    np.testing.assert_allclose(SE3().distance(rigid.compose(moved, x), rigid.compose(moved, y)), SE3().distance(x, y), atol=1e-12)
    q, r, turned = x[:, 3:], y[:, 3:], moved[3:]
    for one, other in (
        (rotations.multiply(turned, q), rotations.multiply(turned, r)),
        (rotations.multiply(q, turned), rotations.multiply(r, turned)),
    ):
        np.testing.assert_allclose(SO3().distance(one, other), SO3().distance(q, r), atol=1e-12)


def test_the_sign_of_a_quaternion_does_not_matter():
    points, weights = cloud(SO3(), 20, 0.4), np.random.default_rng(1).dirichlet(np.ones(20))
    signs = np.where(np.arange(20) % 3 == 0, -1.0, 1.0)[:, None]
    assert SO3().distance(SO3().mean(weights, signs * points), SO3().mean(weights, points)) < 1e-7
    np.testing.assert_allclose(SO3().coordinates(points[0], signs * points), SO3().coordinates(points[0], points), atol=1e-12)


def test_the_mean_of_rotations_about_one_axis_is_that_of_their_angles():
    angles, weights = np.array([-20.0, 10.0, 130.0]) * DEG, np.array([0.5, 0.3, 0.2])
    mean = SO3().mean(weights, rotations.exponential(angles[:, None] * np.array([0.6, 0.0, 0.8])))
    # The extrinsic mean, from which the steps start, is another one.
    np.testing.assert_allclose(rotations.logarithm(mean), weights @ angles * np.array([0.6, 0.0, 0.8]), atol=1e-9)
    assert abs(Rotation.from_rotvec(angles[:, None] * [0.6, 0.0, 0.8]).mean(weights).magnitude() - weights @ angles) > 0.01


def test_names_of_entries_and_tangent_vectors():
    assert PARTS.tangent_labels[:7] == ("torso_x", "torso_y", "torso_z", "torso_rx", "torso_ry", "torso_rz", "head_x")
    assert [axis.name for axis in PARTS.axes] == ["part", "coordinate"] and PARTS.axes[1].labels == ("x", "y", "z", "qw", "qx", "qy", "qz")
    assert MIXED.axes[0].labels == ("x", "y", "yaw", "knee", "wrist_qw", "wrist_qx", "wrist_qy", "wrist_qz")
    assert MIXED.tangent_labels[-3:] == ("wrist_rx", "wrist_ry", "wrist_rz") and MIXED.tangent_units[1:3] == ("m", "rad")
    assert numbered("w", (2, 2)).tangent_labels == ("w_0_0", "w_0_1", "w_1_0", "w_1_1") and numbered("w", ()).tangent_labels == ("w",)


def test_a_quaternion_is_one_block():
    assert MIXED.blocks == (0, 1, 2, 3, 4, 4, 4, 4) and PARTS.blocks == (0,) * 7 + (1,) * 7


def test_text_that_is_no_space_is_refused():
    for text in ("{}", "[]", '{"kind": "SO4"}', '{"kind": "SO3", "radius": 1}'):
        with pytest.raises(ValueError, match="not a space"):
            space_from_text(text)
