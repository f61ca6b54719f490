"""What a camera sees of a solid, and how deep solids stand in one another: closed forms and brute force, in double precision."""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.model.body.build import build_body
from bayes_body.model.body.solids import (
    outline_samples,
    part_transforms,
    patches,
    penetration_depths,
    smooth_penetration_depths,
    sphere_approximation,
    surface_samples,
)
from bayes_body.model.definition import load_body

pytestmark = pytest.mark.usefixtures("x64")

POSE = np.array([0.1, -0.2, 0.3, 0.5, -0.8, 1.1])
VIEWPOINTS = [np.array([3.0, 0.5, 1.0]), np.array([-1.0, 2.0, 0.4]), np.array([0.3, -0.5, -2.0])]


# One program for each form of the arguments, instead of one for each operation.
placed, faced, spheres_of, depths_of = (jax.jit(function) for function in (part_transforms, patches, sphere_approximation, penetration_depths))


class Axes(NamedTuple):
    """Transforms as NumPy arrays, (part, 3) each."""

    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    origin: np.ndarray


def axes_of(T) -> Axes:
    return Axes(*np.moveaxis(np.asarray(T.rotation), -1, 0), np.asarray(T.origin))


def seen(body, pose, viewpoint):
    """The axes of part 0, and its patch as NumPy arrays."""
    T = placed(body, pose)
    return jax.tree.map(lambda leaf: np.asarray(leaf)[0], (axes_of(T), faced(body, T, viewpoint)))


def point(patch, t, s) -> np.ndarray:
    t, s = np.asarray(t)[..., None], np.asarray(s)[..., None]
    return patch.start + t * patch.axis + s * patch.half_width + t * s * patch.taper


@pytest.mark.parametrize("viewpoint", VIEWPOINTS)
def test_a_circular_cylinders_outline_is_poon_and_fleets(free_parts, viewpoint):
    radii, length = (0.11, 0.06), 0.45
    T, patch = seen(free_parts({"length": length, "radii": radii}), POSE, viewpoint)
    a = T.z
    for end in (0, 1):
        e = T.origin + end * length * a
        side = np.cross(a, e - viewpoint)
        side *= radii[end] / np.linalg.norm(side)
        found = sorted(point(patch, end, s).tolist() for s in (-1, 1))
        np.testing.assert_allclose(found, sorted([(e + side).tolist(), (e - side).tolist()]), atol=1e-12)
        np.testing.assert_allclose(point(patch, end, 0), e, atol=1e-12)


@pytest.mark.parametrize("viewpoint", VIEWPOINTS)
def test_an_elliptical_sections_outline_by_brute_force(free_parts, viewpoint):
    radii, length, section = (0.15, 0.12), 0.5, (1.2, 0.5)
    T, patch = seen(free_parts({"length": length, "radii": radii, "section": section}), POSE, viewpoint)
    angle = np.linspace(0, 2 * np.pi, 10_000, endpoint=False)[:, None]
    for end in (0, 1):
        e = T.origin + end * length * T.z
        rim = np.asarray(e + radii[end] * (section[0] * np.cos(angle) * T.x + section[1] * np.sin(angle) * T.y))
        across = rim @ np.cross(T.z, e - viewpoint)
        extremes = sorted(rim[[np.argmin(across), np.argmax(across)]].tolist())
        np.testing.assert_allclose(sorted(point(patch, end, s).tolist() for s in (-1, 1)), extremes, atol=1e-3 * radii[end])


@pytest.mark.parametrize("viewpoint", VIEWPOINTS)
def test_a_spheres_outline_is_the_circle_that_faces_the_view(free_parts, viewpoint):
    # A cylinder beside it: the two kinds share their arrays.
    radius, length = 0.2, 0.3
    body = free_parts({"length": length, "radii": (radius, radius), "kind": "sphere"}, {"length": 0.4, "radii": (0.1, 0.1)})
    T, patch = seen(body, np.concatenate([POSE, POSE + 0.4]), viewpoint)
    centre = T.origin + length / 2 * T.z
    samples = outline_samples(body, 7)
    arms = point(patch, samples.t[0], samples.s[0]) - centre
    np.testing.assert_allclose(np.linalg.norm(arms, axis=1), radius, atol=1e-12)
    np.testing.assert_allclose(arms @ (centre - viewpoint), 0, atol=1e-12)
    assert np.linalg.matrix_rank(arms) == 2
    samples = surface_samples(body, 5, 4)
    arms = point(patch, samples.t[0], samples.s[0]) - centre
    assert np.linalg.norm(arms, axis=1).max() < radius


def test_samples_are_evenly_spaced(free_parts):
    body = free_parts({"length": 1.0, "radii": (0.1, 0.1)})
    outline, surface = outline_samples(body, 4), surface_samples(body, 2, 4)
    assert outline.t.shape == outline.s.shape == (1, 8)
    assert sorted(zip(outline.s[0].tolist(), outline.t[0].tolist(), strict=True)) == [(s, t) for s in (-1, 1) for t in (0.125, 0.375, 0.625, 0.875)]
    grid = sorted(zip(surface.t[0].tolist(), surface.s[0].tolist(), strict=True))
    assert grid == [(t, s) for t in (0.25, 0.75) for s in (-0.75, -0.25, 0.25, 0.75)]


def test_spheres_touch_the_narrow_sides_of_their_sections(free_parts):
    radii, length, section = (0.2, 0.1), 0.8, (0.6, 1.1)
    body = free_parts({"length": length, "radii": radii, "section": section}, spheres_per_part=5)
    T = placed(body, POSE)
    spheres, T = jax.tree.map(np.asarray, spheres_of(body, T)), axes_of(T)
    t = (np.arange(5) + 0.5) / 5
    np.testing.assert_allclose(spheres.centres[0], np.asarray(T.origin[0]) + length * t[:, None] * np.asarray(T.z[0]), atol=1e-12)
    np.testing.assert_allclose(spheres.radii[0], 0.6 * (radii[0] + t * (radii[1] - radii[0])), atol=1e-12)


def test_clothes_are_seen_and_do_not_penetrate(free_parts):
    body = free_parts({"length": 0.8, "radii": (0.2, 0.1)}, {"length": 0.3, "radii": (0.2, 0.2), "kind": "sphere"})
    dressed = replace(body, outline_radii=2 * np.asarray(body.outline_radii))
    T = placed(body, np.array([*POSE, *POSE[::-1]]))
    plain, wide = (jax.tree.map(np.asarray, faced(one, T, VIEWPOINTS[0])) for one in (body, dressed))
    np.testing.assert_allclose(wide.half_width, 2 * plain.half_width, atol=1e-12)
    np.testing.assert_allclose(wide.taper, 2 * plain.taper, atol=1e-12)
    np.testing.assert_allclose(wide.axis[0], plain.axis[0], atol=1e-12)
    np.testing.assert_allclose(wide.axis[1], 2 * plain.axis[1], atol=1e-12)
    np.testing.assert_array_equal(depths_of(dressed, T), depths_of(body, T))


def test_spheres_of_a_sphere_are_that_sphere(free_parts):
    body = free_parts({"length": 0.3, "radii": (0.2, 0.2), "kind": "sphere"})
    T = placed(body, POSE)
    spheres, T = jax.tree.map(np.asarray, spheres_of(body, T)), axes_of(T)
    np.testing.assert_allclose(spheres.centres[0], np.tile(T.origin[0] + 0.15 * T.z[0], (4, 1)), atol=1e-12)
    np.testing.assert_allclose(spheres.radii, 0.2, atol=1e-12)


@pytest.mark.parametrize("name", ["deutscher_31", "arm_4"])
def test_spheres_stay_inside_their_parts(name):
    # Along the axis; across it, by no more than the taper's cosine: less than a millimetre on a human limb.
    body = build_body(name, load_body(name))
    T = placed(body, np.zeros(len(body.dof_names)))
    spheres, T = jax.tree.map(np.asarray, spheres_of(body, T)), axes_of(T)
    radii, sections, lengths = (np.asarray(array) for array in (body.radii, body.sections, body.lengths))
    directions = np.random.default_rng(0).normal(size=(2000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for p, sphere_part in enumerate(body.topology.is_sphere):
        if sphere_part:
            continue
        axes = np.stack([column[p] for column in (T.x, T.y, T.z)], axis=1)
        surface = spheres.centres[p][:, None] + spheres.radii[p][:, None, None] * directions
        x, y, z = np.moveaxis((surface - T.origin[p]) @ axes, -1, 0)
        t = z / lengths[p]
        radius = radii[p, 0] * (1 - t) + radii[p, 1] * t
        beyond = np.hypot(x / sections[p, 0], y / sections[p, 1]) - radius
        assert beyond.max() < 1e-3


def test_depth_of_two_parallel_parts(free_parts):
    # Widest first spheres face each other: r_a(1/8) + r_b(1/8) - distance.
    body = free_parts({"length": 0.4, "radii": (0.12, 0.08)}, {"length": 0.4, "radii": (0.10, 0.06)})
    apart = np.zeros(12)
    for distance in (0.05, 0.2, 0.5):
        apart[6] = distance
        (depth,) = np.asarray(depths_of(body, placed(body, apart)))
        assert depth == pytest.approx(0.115 + 0.095 - distance, abs=1e-12)


def test_depth_of_a_part_across_another(free_parts):
    # Both of constant radius, their axes crossing at a right angle with a gap; nearest centres are half a spacing from the crossing on either axis.
    length, spacing, gap = 0.8, 0.2, 0.15
    body = free_parts({"length": length, "radii": (0.1, 0.1)}, {"length": length, "radii": (0.07, 0.07)})
    # Part 1 runs along x through the middle of part 0.
    pose = np.zeros(12)
    pose[6:] = [-length / 2, gap, length / 2, 0, 0, np.pi / 2]
    (depth,) = np.asarray(depths_of(body, placed(body, pose)))
    nearest = np.sqrt(gap**2 + 2 * (spacing / 2) ** 2)
    assert depth == pytest.approx(0.17 - nearest, abs=1e-12)


def test_depths_of_several_pairs_are_each_their_own(free_parts):
    part = {"length": 0.4, "radii": (0.1, 0.1)}
    body = free_parts(part, part, part)
    pose = np.zeros(18)
    pose[6], pose[12] = 0.15, 0.4
    depths = depths_of(body, placed(body, pose))
    expected = {(1, 0): 0.2 - 0.15, (2, 0): 0.2 - 0.4, (2, 1): 0.2 - 0.25}
    assert dict(zip(body.topology.penetration, depths.tolist(), strict=True)) == pytest.approx(expected, abs=1e-12)


@pytest.mark.slow
def test_the_cheap_gradient_of_the_depths_is_the_same(free_parts):
    part = {"length": 0.4, "radii": (0.12, 0.07)}
    body = free_parts(part, part, part)
    poses = jnp.asarray(np.random.default_rng(1).normal(scale=0.3, size=(20, 18)))
    both = [
        np.asarray(jax.jit(jax.vmap(jax.jacobian(lambda pose, f=f: f(body, part_transforms(body, pose)))))(poses))
        for f in (penetration_depths, smooth_penetration_depths)
    ]
    assert (np.abs(both[0]).max(axis=2) > 0.1).all()
    np.testing.assert_allclose(*both, atol=1e-9)


def test_gradients_are_finite_where_formulas_are_singular(free_parts):
    part = {"length": 0.4, "radii": (0.1, 0.05)}
    body = free_parts(part, part | {"kind": "sphere"})
    end_on = jnp.array([0.0, 0.0, -3.0])

    def total(pose):
        T = part_transforms(body, pose)
        depths = penetration_depths(body, T).sum() + smooth_penetration_depths(body, T).sum()
        return depths + sum(leaf.sum() for leaf in patches(body, T, end_on))

    # Both parts in the same place, seen along their own axis.
    value, gradient = jax.jit(jax.value_and_grad(total))(jnp.zeros(12))
    assert np.isfinite(value)
    assert np.isfinite(gradient).all()
