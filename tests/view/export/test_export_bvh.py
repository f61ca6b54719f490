"""`export bvh`: what a run's mean pose is, read back by our reader, and by one of a few lines that goes by the format's own rules."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bayes_body.base.errors import InputError
from bayes_body.model.body.build import build_body
from bayes_body.model.body.placed_body import joint_transforms, loosened, placed_markers
from bayes_body.model.definition import load_body
from bayes_body.recording.readers.mocap import landmarks, read_motion
from bayes_body.results.posterior.moments import Moments
from bayes_body.results.storage.saved_run import load_run
from bayes_body.view.export.bvh import write_bvh
from bayes_body.view.export.formats import export
from bayes_body.view.export.motion import Motion, Parts
from bayes_body.view.export.world import turned_body

# Six decimals of a centimetre and of a degree, over a chain of a metre; and what 32 bits hold of two metres.
PRINTED_M = 5e-7
TRANSFORMS = jax.jit(jax.vmap(joint_transforms, (None, 0)))
CONFIGURATIONS = jax.jit(jax.vmap(lambda body, pose: body.placement.configuration(body.skeleton, pose), (None, 0)))


@pytest.fixture(scope="module", params=["deutscher_31", "person_35", "loose_limbed"])
def body(request):
    """Bodies placed by angles, of which one has joints without any and fixed angles between free ones, and one placed by its parts."""
    if request.param == "loose_limbed":
        return loosened(build_body("person_31", load_body("person_31")))
    return build_body(request.param, load_body(request.param))


def walk(body, frames=9):
    """Poses of every dof, radians and metres."""
    rng = np.random.default_rng(4)
    low, high = (np.clip(np.asarray(limit), -1, 1) for limit in (body.skeleton.low, body.skeleton.high))
    poses = (low + high) / 2 + rng.normal(0, 0.4, (frames, len(low)))
    poses[:, body.dof_names.index("root_yaw")] = np.linspace(0, 7, frames)
    return poses


def placed(body, poses):
    """What places the body: the poses, or the parts with gaps of centimetres between them."""
    if body.variable == "pose":
        return np.asarray(poses)
    parts = np.array(CONFIGURATIONS(body, jnp.asarray(poses)), float)
    parts[..., :3] += np.random.default_rng(5).normal(0, 0.02, parts[..., :3].shape)
    return parts


def motion_of(body, configurations, order=(0, 1, 2), up="z"):
    if body.variable == "parts":
        return loose_motion_of(body, configurations, order, up)
    poses = configurations.copy()
    # The root's positions are the first three dofs, x, y and z.
    poses[:, :3] = poses[:, list(order)]
    units = tuple("deg" if angular else "m" for angular in body.skeleton.topology.angular)
    mean = np.where(np.array(units) == "deg", np.degrees(poses), poses)
    none = np.zeros((len(poses), 0, 3))
    markers, dofs = Moments(none, none, none, none), Moments(mean, 0 * mean, mean, mean)
    return Motion("walk", 59.94, up, (), markers, body.dof_names, units, dofs, np.zeros(len(poses), bool), turned_body(body, order))


def loose_motion_of(body, parts, order, up):
    none, empty = np.zeros((len(parts), 0, 3)), np.zeros((len(parts), 0))
    markers, dofs, names = Moments(none, none, none, none), Moments(empty, empty, empty, empty), body.placement.names
    # The world's axes are permuted as SciPy does it.
    mean = np.array(parts)
    turn = Rotation.from_matrix(np.eye(3)[list(order)])
    mean[..., :3] = parts[..., list(order)]
    mean[..., 3:] = np.stack([(turn * Rotation.from_quat(each, scalar_first=True)).as_quat(scalar_first=True) for each in parts[..., 3:]])
    spread = Moments(*np.zeros((4, *parts.shape[:2], 3)))
    given = Parts(names, mean, spread, spread)
    return Motion("walk", 59.94, up, (), markers, (), (), dofs, np.zeros(len(parts), bool), turned_body(body, order), parts=given)


def by_the_rules(path):
    """World positions by joint in the last frame, in centimetres: the format's rules, line by line, with SciPy's intrinsic rotations."""
    lines = [line.split() for line in path.read_text().splitlines()]
    values = [float(word) for word in lines[-1]]
    stack, out, name = [], {}, ""
    for words in lines[: lines.index(["MOTION"])]:
        if words[0] in ("ROOT", "JOINT"):
            name = words[1]
        elif words[0] == "End":
            name = f"{stack[-1][0]}_end"
        elif words[0] == "OFFSET":
            offset = np.array([float(word) for word in words[1:]])
            if name.endswith("_end"):
                out[name] = stack[-1][1] + stack[-1][2] @ offset
                stack.append((name, None, None))
        elif words[0] == "CHANNELS":
            if words[1] == "6":
                offset, values = np.array(values[:3]), values[3:]
            R = Rotation.from_euler("ZXY", values[:3], degrees=True).as_matrix()
            values = values[3:]
            p, above = (stack[-1][1], stack[-1][2]) if stack else (np.zeros(3), np.eye(3))
            out[name] = p + above @ offset
            stack.append((name, out[name], above @ R))
        elif words[0] == "}":
            stack.pop()
    assert not values and not stack
    return out


@pytest.mark.parametrize(("up", "order"), [("z", (0, 1, 2)), ("y", (1, 2, 0)), ("x", (2, 0, 1))])
def test_the_mean_pose_comes_back(body, tmp_path, up, order):
    poses, path = placed(body, walk(body)), tmp_path / "walk.bvh"
    write_bvh(motion_of(body, poses, order, up), path)
    back = read_motion(path, up=up)
    assert np.isclose(back.fps, 59.94, rtol=1e-9) and len(back.positions_m) == len(poses)
    transforms = TRANSFORMS(body, jnp.asarray(poses))
    for j, name in enumerate(body.skeleton.topology.joint_names):
        assert np.abs(back.positions_m[:, back.joints.index(name.replace(" ", "_"))] - transforms.origin[:, j]).max() < 4 * PRINTED_M, name
    rules = by_the_rules(path)
    assert set(rules) == set(back.joints)
    for name, place in rules.items():
        turned = place[np.argsort(order)] / 100
        assert np.abs(back.positions_m[-1, back.joints.index(name)] - turned).max() < 1e-9, name


def test_limbs_end_where_markers_are(body, tmp_path):
    poses, path = placed(body, walk(body)), tmp_path / "walk.bvh"
    write_bvh(motion_of(body, poses, (1, 2, 0), "y"), path)
    places = landmarks(read_motion(path, up="y"))
    markers = np.asarray(jax.jit(jax.vmap(partial(placed_markers, body)))(jnp.asarray(poses)))
    for name in ("l_wrist", "r_elbow", "l_ankle", "r_knee", "r_hip", "l_shoulder", "head"):
        assert np.abs(places[name] - markers[:, body.markers.names.index(name)]).max() < 5 * PRINTED_M, name


def test_at_rest_it_stands_in_the_zero_pose(body, tmp_path):
    """All channels but the positions are zero, and the offsets are the body's own."""
    path, zero = tmp_path / "rest.bvh", np.zeros((9, len(body.dof_names)))
    write_bvh(motion_of(body, np.array(CONFIGURATIONS(body, jnp.asarray(zero)), float), (1, 2, 0), "y"), path)
    assert "-0.000000" not in path.read_text()
    values = np.array([[float(word) for word in line.split()] for line in path.read_text().splitlines()[-9:]])
    free = len(body.placement.names) if body.variable == "parts" else 1
    assert values.shape == (9, 3 * free + 3 * len(body.skeleton.topology.joint_names))
    if free == 1:
        assert np.abs(values).max() < 1e-4
    back = read_motion(path, up="y")
    assert np.allclose(back.rotations[:, 0], [[0, 0, 1], [1, 0, 0], [0, 1, 0]], atol=1e-6)
    # It stands upright: the head above the hips, these above the ankles, by the body's lengths.
    heights = {name: back.positions_m[0, back.joints.index(name), 2] for name in back.joints}
    ankle = "l_knee_end" if "l_knee_end" in heights else "l_ankle"
    assert heights["head_end"] - heights["l_hip"] > 0.6 and heights["l_hip"] - heights[ankle] > 0.7


def test_angles_go_on_over_a_turn(body, tmp_path):
    path = tmp_path / "turning.bvh"
    poses = np.zeros((9, len(body.dof_names)))
    poses[:, body.dof_names.index("root_yaw")] = np.linspace(0, 4 * np.pi, 9)
    write_bvh(motion_of(body, np.array(CONFIGURATIONS(body, jnp.asarray(poses)), float)), path)
    values = np.array([[float(word) for word in line.split()] for line in path.read_text().splitlines()[-9:]])
    assert np.abs(np.diff(values[:, 3:6], axis=0)).max() < 91 and np.ptp(values[:, 3:6], axis=0).max() > 700


def test_a_run(make_run, tmp_path):
    """From a run's folder: y up unless something else is asked for; the arm is no person, so its height is not."""
    with load_run(make_run()) as run:
        motion = export(run, "bvh", tmp_path / "arm.bvh")
        assert motion.up == "y"
        export(run, "bvh", tmp_path / "arm_z.bvh", up="z")
    text = (tmp_path / "arm.bvh").read_text()
    assert text.startswith("HIERARCHY\nROOT ") and "Frames: 5\nFrame Time: 0.01666666667\n" in text
    places = [by_the_rules(tmp_path / name) for name in ("arm.bvh", "arm_z.bvh")]
    for name in places[0]:
        assert np.allclose(places[0][name], places[1][name][[1, 2, 0]], atol=1e-4)
    with pytest.raises(InputError, match=r"arm.bvh: a person \d\d(\.\d)? cm tall, in the unit 'cm'"):
        read_motion(tmp_path / "arm.bvh")


def test_a_body_of_two_roots(body, tmp_path):
    topology = body.skeleton.topology
    loose = dataclasses.replace(topology, parents=(-1, -1, *topology.parents[2:]))
    loose = dataclasses.replace(body, skeleton=dataclasses.replace(body.skeleton, topology=loose))
    with pytest.raises(InputError, match=r"--to bvh: the body '.*' has 2 roots; expected exactly one root"):
        write_bvh(motion_of(loose, placed(body, walk(body))), tmp_path / "walk.bvh")
    assert not (tmp_path / "walk.bvh").exists()


def test_a_file_that_cannot_be_written_is_a_sentence(body, tmp_path):
    with pytest.raises(InputError, match=r"cannot be written"):
        write_bvh(motion_of(body, placed(body, walk(body))), tmp_path / "none" / "walk.bvh")
