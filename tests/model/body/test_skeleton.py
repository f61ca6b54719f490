"""Forward kinematics against a chain of 4x4 matrices written out in NumPy from what the body file says."""

import math
import tomllib
from dataclasses import replace
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from bayes_body.base.files.shipped import definitions_folder
from bayes_body.base.geometry import transforms
from bayes_body.model.body.build import build_body
from bayes_body.model.body.kinematics import forward_kinematics, marker_positions
from bayes_body.model.body.schema import BodySchema
from bayes_body.model.body.skeleton import preset_rotation
from bayes_body.model.body.solids import Body

BODIES = ["arm_4", "deutscher_31", "person_35", "person_40"]


def document(name: str) -> dict:
    return tomllib.loads((definitions_folder() / "bodies" / f"{name}.toml").read_text())


def build(table: dict) -> Body:
    return build_body("a test's", BodySchema.model_validate(table))


def rotation(axis: str, angle: float) -> np.ndarray:
    """Right-handed, about a coordinate axis."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array({"x": [[1, 0, 0], [0, c, -s], [0, s, c]], "y": [[c, 0, s], [0, 1, 0], [-s, 0, c]], "z": [[c, -s, 0], [s, c, 0], [0, 0, 1]]}[axis])


def homogeneous(R=np.eye(3), p=(0, 0, 0)) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, p
    return T


def chain(table: dict, pose: dict[str, float]) -> dict[str, np.ndarray]:
    """`T_world_joint` of every joint by name."""
    found = {"world": np.eye(4)}
    waiting = list(table["joint"])
    while waiting:
        joint = waiting.pop(0)
        if joint["parent"] not in found:
            waiting.append(joint)
            continue
        T = found[joint["parent"]] @ homogeneous(p=vector(table, joint.get("offset", {})))
        for preset in joint.get("preset", []):
            T = T @ homogeneous(rotation(preset[0], math.radians(int(preset[1:]))))
        for dof in joint.get("dofs", []):
            fixed = dof.get("low_deg") is not None and dof["low_deg"] == dof["high_deg"]
            axis, value = dof["axis"], math.radians(dof["low_deg"]) if fixed else pose[dof["name"]]
            if axis.startswith("t"):
                T = T @ homogeneous(p=value * np.eye(3)["xyz".index(axis[1])])
            else:
                T = T @ homogeneous(rotation(axis[-1], -value if axis[0] == "-" else value))
        found[joint["name"]] = T
    del found["world"]
    return found


def vector(table: dict, offset: dict) -> list[float]:
    def metres(entry) -> float:
        if not isinstance(entry, str):
            return entry
        return (-1 if entry[0] == "-" else 1) * table["lengths_of_height"][entry.lstrip("-")] * table["height_m"]

    return [metres(offset.get(axis, 0.0)) for axis in "xyz"]


matrices = jax.jit(lambda skeleton, pose: transforms.matrix(forward_kinematics(skeleton, pose)))
positions = jax.jit(marker_positions)
slopes = jax.jit(jax.jacrev(marker_positions, argnums=2))


def joints(body: Body, pose) -> dict[str, np.ndarray]:
    """`T_world_joint` of every joint by name."""
    return dict(zip(body.skeleton.topology.joint_names, np.asarray(matrices(body.skeleton, pose)), strict=True))


def random_pose(body: Body, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-2, 2, len(body.dof_names))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", BODIES)
def test_equals_a_chain_of_matrices(x64, name, seed):
    table = document(name)
    body = build(table)
    pose = random_pose(body, seed)
    found = joints(body, pose)
    expected = chain(table, dict(zip(body.dof_names, pose, strict=True)))
    # A fixed angle after a free one has a frame between them, whose name no file can have.
    assert {name for name in found if not name.startswith("#")} == set(expected)
    for joint, T in expected.items():
        np.testing.assert_allclose(found[joint], T, atol=1e-12, err_msg=joint)


def test_parents_after_their_children(x64):
    table = document("deutscher_31")
    backwards = table | {"joint": table["joint"][::-1]}
    body, turned = build(table), build(backwards)
    assert body.dof_names != turned.dof_names
    pose = dict(zip(body.dof_names, random_pose(body, 4), strict=True))
    expected = body_markers(body, pose)
    found = body_markers(turned, pose)
    for name, position in expected.items():
        np.testing.assert_allclose(found[name], position, atol=1e-12, err_msg=name)


def body_markers(body: Body, pose: dict[str, float]) -> dict[str, np.ndarray]:
    values = np.array([pose[name] for name in body.dof_names])
    return dict(zip(body.markers.names, np.asarray(positions(body.skeleton, body.markers, values)), strict=True))


@pytest.mark.slow
def test_a_joint_that_shifts_after_it_turned(x64):
    table = document("arm_4")
    # It turns, slides along where it then points, and turns again about where it then is.
    table["joint"][1]["dofs"] = [{"name": name, "axis": axis} for name, axis in [("a", "z"), ("b", "ty"), ("c", "-x"), ("d", "tz"), ("e", "tz")]]
    table["joint"][0]["dofs"] = [{"name": "f", "axis": "tx"}, {"name": "g", "axis": "-y"}, {"name": "h", "axis": "-y"}]
    body = build(table)
    pose = random_pose(body, 5)
    found, expected = joints(body, pose), chain(table, dict(zip(body.dof_names, pose, strict=True)))
    for joint, T in expected.items():
        np.testing.assert_allclose(found[joint], T, atol=1e-12, err_msg=joint)
    check_grads(jax.jit(lambda pose: forward_kinematics(body.skeleton, jnp.asarray(pose))), (jnp.asarray(pose),), order=2, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_a_minus_is_the_inverse_turn(x64, axis):
    table = document("arm_4")
    for dof in table["joint"][1]["dofs"]:
        dof["axis"] = axis
    plus = build(table)
    for dof in table["joint"][1]["dofs"]:
        dof["axis"] = f"-{axis}"
    minus = build(table)
    pose, back, straight = (np.array([0.2, -0.4, 0.3, elbow]) for elbow in (0.7, -0.7, 0.0))
    with_plus, with_minus, opposite = (np.asarray(matrices(b.skeleton, p))[-1] for b, p in ((plus, pose), (minus, pose), (minus, back)))
    np.testing.assert_allclose(with_plus, opposite, atol=1e-15)
    assert np.abs(with_plus - with_minus).max() > 0.1
    # One after the other they undo each other: back at the elbow's unturned frame.
    T_elbow = np.asarray(matrices(plus.skeleton, straight))[-1]
    R_start, R_plus, R_minus = (T[:3, :3] for T in (T_elbow, with_plus, with_minus))
    np.testing.assert_allclose(R_start.T @ R_plus @ R_start.T @ R_minus, np.eye(3), atol=1e-14)


@pytest.mark.parametrize("names", list(product("xyz", ("90", "180", "270"))))
def test_presets_are_exact(names):
    axis, degrees = names
    R = np.asarray(preset_rotation([axis + degrees]))
    assert np.array_equal(R, np.rint(rotation(axis, math.radians(int(degrees)))))


def test_presets_multiply_in_order_and_exactly():
    names = ["x270", "z180", "y270", "z90"]
    expected = np.eye(3)
    for name in names:
        expected = expected @ np.rint(rotation(name[0], math.radians(int(name[1:]))))
    assert np.array_equal(preset_rotation(names), expected)
    assert not np.array_equal(preset_rotation(names[::-1]), expected)


def test_markers_of_a_man_who_stands(x64):
    table = document("deutscher_31")
    body = build(table)
    length = {name: share * table["height_m"] for name, share in table["lengths_of_height"].items()}
    torso, head = length["torso"], length["head"]
    found = body_markers(body, dict.fromkeys(body.dof_names, 0.0))
    expected = {"pelvis": (0, 0, 0), "thorax": (0, 0, torso), "head": (0, 0, torso + head)}
    for side, sign in (("l", 1), ("r", -1)):
        thigh, calf = length[f"{side}_thigh"], length[f"{side}_calf"]
        hip = sign * length[f"{side}_pelvis"]
        expected |= {f"{side}_hip": (0, hip, 0), f"{side}_knee": (0, hip, -thigh), f"{side}_ankle": (0, hip, -thigh - calf)}
        upper, fore = length[f"{side}_upper_arm"], length[f"{side}_forearm"]
        shoulder = sign * length[f"{side}_clavicle"]
        # In this chart the arms stretch along -x.
        expected |= {f"{side}_shoulder": (0, shoulder, torso), f"{side}_elbow": (-upper, shoulder, torso)}
        expected |= {f"{side}_wrist": (-upper - fore, shoulder, torso)}
    assert set(found) == set(expected)
    for name, position in expected.items():
        np.testing.assert_allclose(found[name], position, atol=1e-12, err_msg=name)


# The body of 31 dofs is a part of those of 35 and 40.
@pytest.mark.parametrize("name", [pytest.param(name, marks=pytest.mark.long) if name.endswith(("31", "35")) else name for name in BODIES])
def test_the_derivative_is_that_of_the_chain(x64, name):
    body = build(document(name))
    pose = random_pose(body, 7)
    jacobian = np.asarray(slopes(body.skeleton, body.markers, pose))
    step = 1e-6
    for k, move in enumerate(step * np.eye(pose.size)):
        ahead, behind = (np.asarray(positions(body.skeleton, body.markers, pose + sign * move)) for sign in (1, -1))
        np.testing.assert_allclose(jacobian[:, :, k], (ahead - behind) / (2 * step), atol=1e-8)


@pytest.mark.long
@pytest.mark.parametrize(("name", "order"), [pytest.param("arm_4", 2, marks=pytest.mark.slow), ("person_31", 1)])
def test_derivatives_in_both_modes_by_pose_and_lengths(x64, name, order):
    body = build(document(name))
    pose = jnp.asarray(random_pose(body, 8))

    @jax.jit
    @jax.jit
    def frames(*given):
        pose, offsets, presets = (jnp.asarray(each) for each in given)
        return forward_kinematics(replace(body.skeleton, offsets=offsets, presets=presets), pose)

    check_grads(frames, (pose, body.skeleton.offsets, body.skeleton.presets), order=order, atol=1e-6, rtol=1e-6)
    # Lengths alone do not go through the pose's derivative, nor do they turn anything.
    check_grads(lambda offsets: frames(pose, offsets, body.skeleton.presets), (body.skeleton.offsets,), order=order, atol=1e-6, rtol=1e-6)


def test_the_gradient_over_many_poses_is_that_of_each(x64):
    body = build(document("person_31"))
    poses = jnp.asarray(np.stack([random_pose(body, seed) for seed in range(3)]))
    weights = jnp.asarray(np.random.default_rng(0).normal(size=(len(body.markers.names), 3)))

    def total(pose):
        return jnp.sum(weights * jnp.sin(marker_positions(body.skeleton, body.markers, pose)))

    slope = jax.grad(total)
    together, alone = jax.jit(jax.vmap(slope))(poses), jax.jit(slope)
    np.testing.assert_allclose(together, [alone(pose) for pose in poses], atol=1e-12)
