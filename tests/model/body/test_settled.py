"""Angles that markers leave open, second solutions and full turns: the same places, by comparable angles."""

import jax
import numpy as np
import pytest

from bayes_body.model.body.branches import nearest_branch, settled
from bayes_body.model.body.build import build_body
from bayes_body.model.body.kinematics import forward_kinematics, marker_positions
from bayes_body.model.definition import load_body

positions, frames = jax.jit(marker_positions), jax.jit(forward_kinematics)
brought_near = jax.jit(lambda topology, pose, reference: nearest_branch(topology, pose, reference)(pose), static_argnums=0)


@pytest.fixture(scope="module")
def body():
    with jax.enable_x64(True):
        return build_body("person_31", load_body("person_31"))


@pytest.fixture(autouse=True)
def double_precision():
    with jax.enable_x64(True):
        yield


def _pose(body, seed):
    """Arms hang, knees and elbows bend, everything else is near rest."""
    rng = np.random.default_rng(seed)
    pose = dict.fromkeys(body.dof_names, 0.0) | {"l_shoulder_y": -1.4, "r_shoulder_y": 1.4, "l_knee": -0.6, "r_knee": -0.3}
    pose |= {"l_elbow": -0.5, "r_elbow": -0.7}
    return np.array([pose[name] for name in body.dof_names]) + 0.1 * rng.normal(size=len(pose))


@pytest.mark.parametrize("seed", range(3))
def test_a_free_pelvis_comes_to_rest(body, seed):
    """Pitch of the pelvis, undone by hips and thorax, moves no marker; settled, the pose is the same whatever it was."""
    at = {name: k for k, name in enumerate(body.dof_names)}
    pose = _pose(body, seed)
    pose[at["root_roll"]] = 0.0
    places = np.asarray(positions(body.skeleton, body.markers, pose))
    found = []
    for pitch in (-0.4, 0.0, 0.3):
        turned = pose.copy()
        turned[[at[name] for name in ("root_pitch", "thorax_y", "l_hip_y", "r_hip_y")]] += pitch * np.array([1, -1, 1, 1])
        assert np.allclose(positions(body.skeleton, body.markers, turned), places, atol=1e-9)
        found.append(np.asarray(jax.jit(settled)(body, turned)))
        assert np.abs(positions(body.skeleton, body.markers, found[-1]) - places).max() < 1.5e-3
    assert np.abs(found[0] - found[1]).max() < 1e-3 and np.abs(found[2] - found[1]).max() < 1e-3
    assert abs(found[1][at["thorax_y"]]) < np.radians(5)


@pytest.mark.parametrize("seed", range(3))
def test_the_nearest_branch_has_the_same_rotations(body, seed):
    rng = np.random.default_rng(seed)
    reference = _pose(body, 0)
    pose = reference + 0.2 * rng.normal(size=reference.shape)
    away = pose.copy()
    angular = np.array(body.skeleton.topology.angular)
    away[angular] += 2 * np.pi * rng.integers(-2, 3, size=angular.sum())
    for motions in body.skeleton.topology.motions:
        if len(motions) == 3:
            y, x, z = (motion.dof for motion in motions)
            away[[y, x, z]] = away[y] + np.pi, np.pi - away[x], away[z] - np.pi
    T_away, T_here = (frames(body.skeleton, angles) for angles in (away, pose))
    assert all(np.allclose(a, b, atol=1e-9) for a, b in zip(T_away, T_here, strict=True))
    found = brought_near(body.skeleton.topology, away, reference)
    assert np.allclose(found, pose, atol=1e-9)
