"""The inner loop's projection, with its derivative written by hand, against `camera.project` on the same points."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.base.geometry.camera import Camera, project
from bayes_body.model.body.solids import Samples, outline_samples, part_transforms, patches, surface_samples
from bayes_body.model.likelihood.patch_pixels import rig_pixels

pytestmark = pytest.mark.usefixtures("x64")


def samples(body) -> Samples:
    pair = (surface_samples(body, 3, 2), outline_samples(body, 3))
    return Samples(*(jnp.asarray(np.concatenate(axis, axis=1)) for axis in zip(*pair, strict=True)))


@jax.jit
def by_points(body, rig: Camera, where: Samples, pose):
    """Points of the patches in the world, each projected on its own."""
    T, t, s = part_transforms(body, pose), where.t[..., None], where.s[..., None]

    def one(camera):
        start, along, across, taper = (vector[:, None] for vector in patches(body, T, camera.viewpoint))
        return project(camera, start + t * along + s * across + t * s * taper)

    return jax.vmap(one)(rig)


pixels_of = jax.jit(rig_pixels)


@jax.jit
def pulled_back(body, rig, where: Samples, pose, cotangent):
    """The cotangent of the pixels as one of the pose: of the inner loop, and of the points one by one."""
    _, back = jax.vjp(lambda p: rig_pixels(body, rig, where, p)[:2], pose)
    _, back_by_points = jax.vjp(lambda p: by_points(body, rig, where, p)[0], pose)
    return back((cotangent[..., 0], cotangent[..., 1]))[0], back_by_points(cotangent)[0]


@pytest.mark.parametrize("name", ["arm_4", "deutscher_31"])
def test_pixels_and_visibility(scene, name):
    body, rig, _, pose = scene(name)
    pixels, visible = by_points(body, rig, samples(body), pose)
    found = pixels_of(body, rig, samples(body), pose)
    np.testing.assert_allclose(np.stack([found.u, found.v], axis=-1), pixels, rtol=1e-9)
    np.testing.assert_array_equal(found.visible, visible)
    assert visible.all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["arm_4", "deutscher_31"])
def test_derivative(scene, name):
    body, rig, _, pose = scene(name)
    where = samples(body)
    rng = np.random.default_rng(5)
    for _ in range(5):
        found, expected = (np.asarray(slope) for slope in pulled_back(body, rig, where, pose, rng.normal(size=(2, *where.t.shape, 2))))
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
        assert np.abs(expected).min() > 1e-3


@pytest.mark.slow
def test_among_the_parts(scene):
    # Cameras within the body: points behind one, and past the turning point of a lens that turns early, are not visible; no derivative is infinite.
    body, rig, _, pose = scene("deutscher_31")
    inside = np.array([[0.0, 0.02, -0.1], [0.1, 0.0, 0.3]])
    rotation = np.asarray(rig.rotation)
    moved = Camera(**(vars(rig) | {"translation": jnp.asarray(-np.einsum("cij,cj->ci", rotation, inside)), "radius_max": jnp.array([1e3, 0.4])}))
    where = samples(body)
    pixels, visible = by_points(body, moved, where, pose)
    found = pixels_of(body, moved, where, pose)
    np.testing.assert_array_equal(found.visible, visible)
    visible, pixels = np.asarray(visible), np.asarray(pixels)
    assert 0.1 < visible[0].mean() < 0.9
    assert 0.0 < visible[1].mean() < visible[0].mean()
    np.testing.assert_allclose(np.asarray(found.u)[visible], pixels[..., 0][visible], rtol=1e-9)

    def seen(pixels_of):
        def total(p):
            u, v = pixels_of(p)
            # What a look-up does: nothing comes back from what is not visible.
            return jnp.sum(jnp.where(visible, jnp.tanh(u / 1e3) + jnp.tanh(v / 1e3), 0.0))

        return np.asarray(jax.jit(jax.grad(total))(pose))

    expected = seen(lambda p: jnp.moveaxis(by_points(body, moved, where, p)[0], -1, 0))
    np.testing.assert_allclose(seen(lambda p: rig_pixels(body, moved, where, p)[:2]), expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
