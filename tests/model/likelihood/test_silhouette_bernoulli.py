"""The silhouette's likelihood: distances against OpenCV's, all images of a small grid sum to one, and what is drawn has its probabilities."""

from dataclasses import replace
from itertools import product

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.base.registry import find
from bayes_body.density.factor import Factor, Variable
from bayes_body.model.body.solids import part_transforms
from bayes_body.model.likelihood.outlines import outline_forms, signed_distance
from bayes_body.recording.evidence.silhouettes import SilhouetteEvidence
from bayes_body.recording.observation.silhouette_bernoulli import sample_mask

POSE = Variable("pose")


def factor(scene, **options) -> Factor:
    term = find("likelihood", "silhouette_bernoulli")
    return term.build(name="images", options=term.options(**options), body=scene.body, rig=scene.rig)


@jax.jit
def log_density(f: Factor, pose, seen: SilhouetteEvidence) -> jax.Array:
    return f({POSE: pose}, {"images": seen})


@jax.jit
def gradient_of(f: Factor, pose, seen: SilhouetteEvidence) -> jax.Array:
    return jax.grad(lambda s: log_density(f, s, seen))(pose)


@jax.jit
def drawn(f: Factor, pose) -> SilhouetteEvidence:
    return f.simulate(jax.random.key(2), {POSE: pose})


@jax.jit
def foreground(f: Factor, pose) -> jax.Array:
    return f.log_potential.foreground(pose)


transforms_of, forms_of = jax.jit(part_transforms), jax.jit(outline_forms)
distances_of = jax.jit(signed_distance, static_argnums=0)


def opencv_outline(scene, c: int, p: int) -> np.ndarray:
    """The outline of a part in a camera as a polygon, pixels, by OpenCV."""
    camera = jax.tree.map(lambda leaf: np.asarray(leaf, float)[c], scene.rig)
    T = transforms_of(scene.body, scene.pose)
    x, y, z, origin = *np.asarray(T.rotation, float)[p].T, np.asarray(T.origin, float)[p]
    length, (r0, r1), (sx, sy) = (np.asarray(array)[p] for array in (scene.body.lengths, scene.body.radii, scene.body.sections))
    viewpoint = -camera.rotation.T @ camera.translation
    if scene.body.topology.is_sphere[p]:
        centre = origin + length / 2 * z
        basis = np.linalg.svd((centre - viewpoint)[None])[2][1:]
        turns = np.linspace(0, 2 * np.pi, 100, endpoint=False)
        world = centre + r0 * (np.cos(turns)[:, None] * basis[0] + np.sin(turns)[:, None] * basis[1])
    else:
        view = origin - viewpoint
        normal = np.array([view @ y / sy, -view @ x / sx])
        side = (np.array([sx, sy]) * normal / np.linalg.norm(normal)) @ np.stack([x, y])
        tip = origin + length * z
        world = np.array([origin - r0 * side, tip - r1 * side, tip + r1 * side, origin + r0 * side])
    xy = cv2.projectPoints(world, cv2.Rodrigues(camera.rotation)[0], camera.translation, np.eye(3), camera.distortion)[0][:, 0]
    u = camera.focal[0] * (xy[:, 0] + camera.skew * xy[:, 1]) + camera.centre[0]
    return np.stack([u, camera.focal[1] * xy[:, 1] + camera.centre[1]], axis=1)


def distances(scene, c: int, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    size = np.asarray(scene.rig.size)[c]
    forms = np.asarray(forms_of(scene.body, scene.rig, scene.pose))[c]
    return np.asarray(distances_of(scene.body.topology, forms, u - size[0] / 2, v - size[1] / 2))


@pytest.mark.parametrize(
    ("name", "c"), [("arm_4", 0), ("deutscher_31", 1), *(pytest.param(*case, marks=pytest.mark.slow) for case in (("arm_4", 1), ("deutscher_31", 0)))]
)
def test_distances_are_opencvs(x64, scene, name, c):
    scene = scene(name)
    width, height = np.asarray(scene.rig.size[c])
    u, v = np.arange(0.5, width - 1, 2), np.arange(0.5, height - 1, 2)
    found = distances(scene, c, u, v)
    outlines = [np.float32(opencv_outline(scene, c, p)) for p in range(len(scene.body.topology.names))]
    expected = np.array([[max(cv2.pointPolygonTest(o, (float(x), float(y)), True) for o in outlines) for x in u] for y in v])
    assert (expected > 1).sum() > 20
    clear = np.abs(expected) > 0.3
    assert (np.sign(found) == np.sign(expected))[clear].all()
    # Inside of cylinders it is the distance itself; near a sphere's outline almost; outside a corner is farther than the lines through its sides.
    near = np.abs(expected) < 1.5
    assert near.sum() > 20
    assert np.median(np.abs(found - expected)[near]) < 0.02
    if not any(scene.body.topology.is_sphere):
        assert (found >= expected - 0.02)[expected < 0].all()
        np.testing.assert_allclose(found[expected > 0], expected[expected > 0], atol=1e-3)


def test_all_silhouettes_of_a_grid_sum_to_one(x64, scene):
    scene = scene("arm_4")
    # The shoulder is in the middle of each image.
    f = factor(scene, grid=(3, 2), soft_px=8.0, false_alarm=0.1)
    assert foreground(f, scene.pose).max() > 0.3
    images = np.array(list(product([False, True], repeat=12))).reshape(-1, 2, 2, 3)
    values = jax.jit(jax.vmap(lambda z: log_density(f, scene.pose, SilhouetteEvidence(z, jnp.ones(2, bool)))))(images)
    assert np.exp(values).sum() == pytest.approx(1, abs=1e-9)
    assert np.exp(values).max() < 0.9


def test_it_is_the_sum_of_the_pixels_and_of_the_cameras_that_saw_the_frame(x64, scene):
    scene = scene("deutscher_31")
    f = factor(scene, miss=0.1)
    seen, p = drawn(f, scene.pose), np.asarray(foreground(f, scene.pose))
    terms = np.where(seen.foreground, np.log(p), np.log1p(-p)).sum(axis=(1, 2))
    assert log_density(f, scene.pose, seen) == pytest.approx(terms.sum(), rel=1e-9)
    half = seen._replace(has_image=jnp.array([False, True]))
    assert log_density(f, scene.pose, half) == pytest.approx(terms[1], rel=1e-9)
    assert log_density(f, scene.pose, seen._replace(has_image=jnp.zeros(2, bool))) == 0
    # What another person covers is no datum.
    uncovered = np.random.default_rng(3).random(p.shape) < 0.7
    visible = np.where(uncovered, np.where(seen.foreground, np.log(p), np.log1p(-p)), 0.0).sum()
    assert log_density(f, scene.pose, seen._replace(uncovered=jnp.asarray(uncovered))) == pytest.approx(visible, rel=1e-9)


def test_probabilities_go_from_false_alarm_to_miss(x64, scene):
    scene = scene("deutscher_31")
    p = np.asarray(foreground(factor(scene, false_alarm=0.03, miss=0.2, soft_px=0.5), scene.pose))
    assert p.min() == pytest.approx(0.03, abs=1e-6) and p.max() == pytest.approx(0.8, abs=1e-6)
    # The points are pixels' centres, of both cameras' sizes.
    for c, (width, height) in enumerate(np.asarray(scene.rig.size).astype(int)):
        mask = np.zeros((height, width), np.uint8)
        for part in range(len(scene.body.topology.names)):
            cv2.fillConvexPoly(mask, np.rint(opencv_outline(scene, c, part) * 16).astype(np.int32), 1, shift=4)
        assert ((p[c] > 0.4) == sample_mask(mask > 0, 64, 48)).mean() > 0.98
        assert 0.01 < (p[c] > 0.4).mean() < 0.5


@pytest.mark.slow
def test_what_is_drawn_has_the_probabilities(scene):
    scene, count = scene("arm_4"), 3000
    f = factor(scene, grid=(32, 24))
    images = jax.jit(jax.vmap(lambda key: f.simulate(key, {POSE: scene.pose}).foreground))(jax.random.split(jax.random.key(1), count))
    p = np.asarray(foreground(f, scene.pose), float)
    z = (np.asarray(images).mean(axis=0) - p) / np.sqrt(p * (1 - p) / count)
    assert np.abs(z).max() < 5
    assert abs((z**2).mean() - 1) < 5 * np.sqrt(2 / z.size)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["arm_4", "deutscher_31"])
def test_the_gradient_is_the_densitys(x64, scene, name):
    scene = scene(name)
    f = factor(scene, soft_px=6.0)
    seen = drawn(f, scene.pose + 0.1)
    gradient, pose = np.asarray(gradient_of(f, scene.pose, seen)), np.asarray(scene.pose)
    for k, step in enumerate(1e-5 * np.eye(pose.size)):
        slope = (float(log_density(f, pose + step, seen)) - float(log_density(f, pose - step, seen))) / 2e-5
        # A point whose form changes within the step has two slopes.
        assert float(slope) == pytest.approx(float(gradient[k]), rel=2e-3, abs=2e-2), scene.body.dof_names[k]
    assert np.linalg.norm(gradient) > 10


@pytest.mark.slow
def test_it_is_greatest_near_the_pose_that_it_was_drawn_at(x64, scene):
    scene = scene("arm_4")
    f = factor(scene)
    seen = drawn(f, scene.pose)
    for k in range(4):
        values = [float(log_density(f, scene.pose.at[k].add(off), seen)) for off in (-0.3, 0.0, 0.3)]
        assert np.argmax(values) == 1, scene.body.dof_names[k]


@pytest.mark.slow
def test_a_body_that_no_camera_sees(scene):
    scene = scene("arm_4")
    turn = jnp.diag(jnp.array([-1.0, 1.0, -1.0]))
    away = replace(scene.rig, rotation=turn @ scene.rig.rotation, translation=scene.rig.translation @ turn)
    f = factor(scene._replace(rig=away), false_alarm=0.02)
    np.testing.assert_allclose(foreground(f, scene.pose), 0.02, atol=1e-6)
    seen = drawn(f, scene.pose)
    assert (gradient_of(f, scene.pose, seen) == 0).all()
    assert np.isnan(log_density(f, scene.pose.at[0].set(jnp.nan), seen))


@pytest.mark.slow
def test_data_of_another_grid(scene):
    scene = scene("arm_4")
    seen = drawn(factor(scene, grid=(20, 16)), scene.pose)
    with pytest.raises(InputError, match="silhouettes on a grid of 20 x 16; expected 32 x 24"):
        log_density(factor(scene, grid=(32, 24)), scene.pose, seen)
