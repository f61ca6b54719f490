"""Packed maps: a look-up is what indexing and interpolation by hand give, and nothing jumps where the image ends."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.base.geometry.camera import Camera, Pixels
from bayes_body.recording.evidence.silhouette_edges import EDGES, SILHOUETTE, look_up, pack, quantised

OUTSIDE = 0.5
# (rows, columns) of two cameras' images: the second is smaller both ways.
SHAPES = ((9, 14), (7, 11))
LEVEL = 1 / 255


@pytest.fixture(params=["nearest", "bilinear"])
def kind(request) -> str:
    return request.param


@pytest.fixture
def x64():
    """Double precision."""
    with jax.enable_x64(True):
        yield


def values() -> list[list[np.ndarray]]:
    """For each camera its two maps, whole levels of 1/255."""
    rng = np.random.default_rng(8)
    return [[rng.integers(0, 256, shape) * LEVEL for _ in range(2)] for shape in SHAPES]


def rig() -> Camera:
    """Two cameras of which only the size matters."""
    leaves = {"rotation": np.eye(3), "translation": (0, 0, 0), "focal": (1, 1), "centre": (0, 0), "skew": 0, "distortion": [0] * 5, "radius_max": 1}
    same = {name: jnp.asarray(np.stack([np.asarray(leaf, float)] * 2)) for name, leaf in leaves.items()}
    return Camera(**same, size=jnp.asarray([(columns, rows) for rows, columns in SHAPES], float))


@partial(jax.jit, static_argnames="kind")
def values_at(maps, which, kind, cameras, pixels):
    return look_up(maps, which, kind, cameras, pixels)[:, 0]


@partial(jax.jit, static_argnames="kind")
def slopes_at(maps, which, kind, cameras, pixels):
    """The derivatives by u and by v, of each camera at its pixels."""
    return jax.grad(lambda u, v: values_at(maps, which, kind, cameras, Pixels(u, v, pixels.visible)).sum(), (0, 1))(pixels.u, pixels.v)


def look(kind, u, v, visible=True, which=SILHOUETTE, function=values_at):
    """Values of both cameras at the same pixels, (camera, point), or another function of what is looked up there."""
    largest = tuple(max(extent) for extent in zip(*SHAPES, strict=True))
    maps = pack(np.stack([np.stack([quantised(one, OUTSIDE, largest) for one in camera]) for camera in values()]))
    u, v = (jnp.asarray(np.broadcast_to(axis, (2, 1, np.size(axis))), float) for axis in (u, v))
    seen = jnp.asarray(np.broadcast_to(visible, u.shape))
    return function(maps, jnp.asarray(np.full(u.shape[-1], which)), kind, rig(), Pixels(u, v, seen))


def grid(shape) -> tuple[np.ndarray, np.ndarray]:
    rows, columns = shape
    v, u = np.mgrid[:rows, :columns]
    return u.ravel(), v.ravel()


@pytest.mark.parametrize("which", [SILHOUETTE, EDGES])
@pytest.mark.parametrize("camera", [0, 1])
def test_at_pixels_it_is_the_map(kind, camera, which):
    u, v = grid(SHAPES[camera])
    found = np.asarray(look(kind, u, v, which=which))[camera]
    np.testing.assert_allclose(found, values()[camera][which][v, u], atol=1e-6)


@pytest.mark.parametrize("camera", [0, 1])
def test_nearest_is_direct_indexing(camera):
    rows, columns = SHAPES[camera]
    rng = np.random.default_rng(1)
    u, v = rng.uniform(-0.499, columns - 0.501, 500), rng.uniform(-0.499, rows - 0.501, 500)
    expected = values()[camera][SILHOUETTE][np.rint(v).astype(int), np.rint(u).astype(int)]
    np.testing.assert_allclose(np.asarray(look("nearest", u, v))[camera], expected, atol=1e-6)


@pytest.mark.parametrize("camera", [0, 1])
def test_bilinear_is_interpolation_by_hand(camera):
    rows, columns = SHAPES[camera]
    rng = np.random.default_rng(2)
    u, v = rng.uniform(-1, columns - 1e-2, 500), rng.uniform(-1, rows - 1e-2, 500)
    bordered = np.pad(values()[camera][SILHOUETTE], 1, constant_values=OUTSIDE)
    i, j = np.floor(v).astype(int) + 1, np.floor(u).astype(int) + 1
    a, b = u + 1 - j, v + 1 - i
    top, bottom = ((1 - a) * bordered[row, j] + a * bordered[row, j + 1] for row in (i, i + 1))
    # One level: 0.5, the border, is no whole number of levels.
    np.testing.assert_allclose(np.asarray(look("bilinear", u, v))[camera], (1 - b) * top + b * bottom, atol=LEVEL)


def test_values_between_levels_are_rounded():
    packed = pack(quantised(np.array([[0.0, 0.31, 1.0, 1.7, -0.2]]), 0.0, (1, 5)))
    assert (packed[1, 1:6] & 255).tolist() == [0, round(0.31 * 255), 255, 255, 0]


def test_outside_is_the_borders_value(kind):
    # The far corner of the larger image is outside the smaller one.
    u, v = np.array([-1.0, -50, 1e6, 3, 3, 14, 3e38]), np.array([3.0, 3, 3, -1, 1e6, 9, -3e38])
    np.testing.assert_allclose(look(kind, u, v), OUTSIDE, atol=LEVEL)
    first, second = np.asarray(look(kind, 12.0, 8.0))
    assert np.abs(first - OUTSIDE) > 2 * LEVEL
    np.testing.assert_allclose(second, OUTSIDE, atol=LEVEL)


def test_not_visible_is_the_borders_value(kind):
    u, v = grid(SHAPES[1])
    np.testing.assert_allclose(look(kind, u, v, visible=False), OUTSIDE, atol=LEVEL)
    assert np.abs(np.asarray(look(kind, u, v)) - OUTSIDE).max() > 0.4


def test_bilinear_is_continuous_across_the_border(x64):
    # A step of a thousandth of a pixel changes a value in [0, 1] by no more than that on either axis; the far end is cut a thousandth short.
    step = 1e-3
    along = np.arange(-3, 17, step)
    for u, v in ((along, np.full_like(along, 4.3)), (np.full_like(along, 5.6), along), (along, along * 0.6)):
        assert np.abs(np.diff(look("bilinear", u, v), axis=1)).max() < 2.1 * step


def test_derivative_is_that_inside_a_cell(x64):
    rng = np.random.default_rng(4)
    u, v = rng.integers(-1, 14, 200) + rng.uniform(0.01, 0.99, 200), rng.integers(-1, 9, 200) + rng.uniform(0.01, 0.99, 200)
    inside = np.stack([(u < columns - 0.01) & (v < rows - 0.01) for rows, columns in SHAPES])
    assert inside.sum() > 200
    step = 1e-5
    along_u, along_v = (np.asarray(slope)[:, 0] for slope in look("bilinear", u, v, function=slopes_at))
    for slope, du, dv in ((along_u, step, 0), (along_v, 0, step)):
        ahead, behind = (np.asarray(look("bilinear", u + sign * du, v + sign * dv)) for sign in (1, -1))
        difference = (ahead - behind) / (2 * step)
        for camera in (0, 1):
            np.testing.assert_allclose(slope[camera, inside[camera]], difference[camera, inside[camera]], atol=1e-8)
            assert np.abs(difference[camera]).max() > 0.1
