"""The world's frame is a convention: body and cameras moved together give the same pixels, the same likelihood and the same constraint."""

from dataclasses import replace

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.base.geometry import transforms
from bayes_body.base.geometry.camera import Camera, project
from bayes_body.density.factor import Variable
from bayes_body.model.body.kinematics import forward_kinematics, marker_positions
from bayes_body.model.likelihood.patch_pixels import rig_pixels

POSE = Variable("pose")
R_NEW_OLD = cv2.Rodrigues(np.array([0.5, -0.7, 1.9]))[0]
P_NEW_OLD = np.array([0.7, -1.3, 0.4])

placed_joints = jax.jit(lambda skeleton, pose: transforms.matrix(forward_kinematics(skeleton, pose)))
placed_markers = jax.jit(marker_positions)
pixels_of = jax.jit(rig_pixels)
projected = jax.jit(jax.vmap(lambda camera, points: project(camera, points)[0], (0, None)))
evaluate = jax.jit(lambda factor, pose, maps: factor({POSE: pose}, {"images": maps}))


def moved_rig(rig: Camera) -> Camera:
    """The cameras in the new world: what they see of a moved point is what they saw of the point."""
    rotation = np.asarray(rig.rotation) @ R_NEW_OLD.T
    translation = np.asarray(rig.translation) - rotation @ P_NEW_OLD
    return replace(rig, rotation=jnp.asarray(rotation, rig.focal.dtype), translation=jnp.asarray(translation, rig.focal.dtype))


def moved_pose(body, pose) -> jax.Array:
    """The pose whose root is the moved one, T(x, y, z) Rz(yaw) Rx(roll) Ry(pitch)."""
    names = body.dof_names
    assert names[:6] == ("root_x", "root_y", "root_z", "root_yaw", "root_roll", "root_pitch")
    root = np.asarray(placed_joints(body.skeleton, pose), float)[0]
    M, p = R_NEW_OLD @ root[:3, :3], R_NEW_OLD @ root[:3, 3] + P_NEW_OLD
    angles = [np.arctan2(-M[0, 1], M[1, 1]), np.arcsin(M[2, 1]), np.arctan2(-M[2, 0], M[2, 2])]
    return jnp.asarray([*p, *angles, *np.asarray(pose)[6:]], pose.dtype)


@pytest.fixture(params=["float32", "float64"])
def case(request, scene):
    """A man, and how far pixels may differ."""
    with jax.enable_x64(request.param == "float64"):
        man = scene("deutscher_31")
        assert man.pose.dtype == request.param
        yield man, {"float32": 1e-3, "float64": 1e-8}[request.param]


def test_markers_move_with_the_world(x64, scene):
    body, _, _, pose = scene("deutscher_31")
    before, after = (np.asarray(placed_markers(body.skeleton, body.markers, p)) for p in (pose, moved_pose(body, pose)))
    np.testing.assert_allclose(after, before @ R_NEW_OLD.T + P_NEW_OLD, atol=1e-12)
    assert np.abs(after - before).max() > 1


def test_pixels_stay(case):
    man, tolerance = case
    body, rig, pose = man.body, man.rig, man.pose
    samples = man.factor().log_potential.samples
    before = pixels_of(body, rig, samples, pose)
    after = pixels_of(body, moved_rig(rig), samples, moved_pose(body, pose))
    for a, b in zip(after[:2], before[:2], strict=True):
        np.testing.assert_allclose(a, b, atol=tolerance)
    np.testing.assert_array_equal(after.visible, before.visible)
    # Neither alone.
    assert np.abs(np.asarray(pixels_of(body, rig, samples, moved_pose(body, pose)).u) - before.u).max() > 10
    # Markers go through `camera.project`, not through the patches.
    seen = [projected(r, placed_markers(body.skeleton, body.markers, p)) for r, p in ((rig, pose), (moved_rig(rig), moved_pose(body, pose)))]
    np.testing.assert_allclose(*seen, atol=tolerance)


@pytest.mark.parametrize("gamma", [0.0, 5.0])
def test_the_likelihood_stays(case, gamma):
    man, tolerance = case
    maps, pose = man.maps(), moved_pose(man.body, man.pose)
    here, there = (one.factor(gamma=gamma) for one in (man, man._replace(rig=moved_rig(man.rig))))
    before, after = float(evaluate(here, man.pose, maps)), float(evaluate(there, pose, maps))
    # An error map changes by less than one a pixel; W of a small area may magnify it.
    assert after == pytest.approx(before, rel=10 * tolerance)
    assert abs(float(evaluate(here, pose, maps)) - before) > 1e-2


def test_the_cameras_have_no_order(x64, scene):
    man = scene("deutscher_31")
    maps = man.maps()
    swapped_rig, swapped_maps = (jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[::-1]), tree) for tree in (man.rig, maps))
    before = float(evaluate(man.factor(), man.pose, maps))
    both = evaluate(man._replace(rig=swapped_rig).factor(), man.pose, swapped_maps)
    assert both == pytest.approx(before, rel=1e-12)
    assert abs(float(evaluate(man.factor(), man.pose, swapped_maps)) - before) > 1e-3
