"""A motion of the body's own skeleton comes back as the angles that made it, and nothing else is called exact."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bayes_body.initial.retarget import retarget
from bayes_body.initial.retarget.exact import angles_of, decompose
from bayes_body.model.body.build import Shape, build_body
from bayes_body.recording.readers.mocap import read_motion
from bayes_body.results.posterior.moments import Moments
from bayes_body.view.export.bvh import write_bvh
from bayes_body.view.export.motion import Motion as Exported
from bayes_body.view.export.world import turned_body, turned_dofs

# Fits and replications run for longer than they compile.
pytestmark = pytest.mark.usefixtures("optimised")

FRAMES = 40
# Limits within which no joint of this body has two triples of angles for one rotation.
WIDE = 0.5


@pytest.fixture(scope="module")
def lengths(schema):
    return {name: share * 1.75 for name, share in schema.lengths_of_height.items()}


@pytest.fixture(scope="module")
def angles(schema):
    """Every dof swings within its limits, at a pace of its own; the person turns once around."""
    rng, t = np.random.default_rng(3), np.arange(FRAMES) / 60
    out = {}
    for joint in schema.joints:
        for dof in joint.dofs:
            low, high = dof.limits
            low, high = (max(np.radians(low), -WIDE), min(np.radians(high), WIDE)) if low is not None and not dof.is_shift else (-WIDE, WIDE)
            out[dof.name] = (low + high) / 2 + 0.49 * (high - low) * np.sin(rng.uniform(2, 8) * t + rng.uniform(0, 6))
    out["root_yaw"] = 2.0 + 2 * np.pi * t / t[-1]
    return out


def _array(body, angles):
    return np.stack([angles[name] for name in body.dof_names], axis=1)


@pytest.mark.parametrize("at_rest", [False, True])
def test_the_angles_that_made_a_motion_come_back(body, own_motion, lengths, angles, at_rest):
    found = retarget(body, own_motion(lengths, angles, at_rest), fit_lengths=False)
    assert found.exact
    difference = found.angles - _array(body, angles)
    # A full turn more is the same angle; which one an unbounded dof begins with is nobody's business.
    difference -= 2 * np.pi * np.round(difference[:1] / (2 * np.pi))
    assert np.abs(difference).max() < 1e-5
    assert np.abs(np.diff(found.angles, axis=0)).max() < 0.3
    assert found.residual().max_mm < 0.01
    assert found.remarks == ()


def test_lengths_become_the_motions_own(body, own_motion, lengths, angles):
    longer = {name: length * (1.1 if "thigh" in name else 0.95) for name, length in lengths.items()}
    motion = own_motion(longer, angles)
    found = retarget(body, motion)
    assert found.exact
    in_joints = [name for name in longer if not name.endswith(("calf", "forearm", "head"))]
    assert all(abs(found.lengths_m[name] - longer[name]) < 1e-6 for name in in_joints)
    # What no joint hangs on is not in the motion: it stays as it was.
    assert found.lengths_m["l_calf"] == pytest.approx(lengths["l_calf"], abs=1e-6)
    assert decompose(body, motion, {}, None) is None


@pytest.mark.slow
def test_lengths_that_end_a_limb_are_those_of_its_points(body, own_motion, lengths, angles):
    longer = {name: length * (1.07 if "calf" in name else 0.9 if name == "r_forearm" else 1.02) for name, length in lengths.items()}
    found = retarget(body, _with_ends(own_motion(longer, angles), longer))
    assert found.exact
    assert all(abs(found.lengths_m[name] - longer[name]) < 1e-5 for name in longer)
    assert found.residual().max_mm < 0.02


@pytest.mark.slow
@pytest.mark.parametrize(("up", "order"), [("z", (0, 1, 2)), ("y", (1, 2, 0))])
def test_an_exported_bvh_gives_its_angles_back(schema, angles, lengths, tmp_path, up, order):
    longer = {name: 1.03 * length for name, length in lengths.items()}
    body = build_body("deutscher_31", schema, Shape(1.75, longer))
    turned, poses = np.array(body.skeleton.topology.angular), _array(body, angles)
    dofs = Moments(*[np.where(turned, np.degrees(poses), poses)] * len(Moments._fields))
    units = tuple("deg" if angular else "m" for angular in turned)
    placing = turned_dofs(dofs, body, order)
    motion = Exported("t", 60.0, up, (), dofs, body.dof_names, units, placing, np.zeros(FRAMES, bool), turned_body(body, order))
    write_bvh(motion, tmp_path / "t.bvh")
    found = retarget(build_body("deutscher_31", schema), read_motion(tmp_path / "t.bvh"), schema=schema)
    assert found.exact
    difference = found.angles - poses
    assert np.abs(difference - 2 * np.pi * np.round(difference[:1] / (2 * np.pi))).max() < 1e-5
    assert all(abs(found.lengths_m[name] - longer[name]) < 1e-5 for name in longer)


def _with_ends(motion, lengths):
    """The motion with a wrist, an ankle and a crown beyond its last joints, as bvh names them."""
    ends = {"head": (0, 0, lengths["head"])}
    for side in "lr":
        ends |= {f"{side}_knee": (0, 0, lengths[f"{side}_calf"]), f"{side}_elbow": (0, 0, -lengths[f"{side}_forearm"])}
    own = [motion.joints.index(name) for name in ends]
    R, p = motion.rotations[:, own], motion.positions_m[:, own]
    places = p + np.einsum("fjab,jb->fja", R, np.array(list(ends.values())))
    return replace(
        motion,
        joints=(*motion.joints, *(f"{name}_end" for name in ends)),
        parents=(*motion.parents, *own),
        positions_m=np.concatenate([motion.positions_m, places], 1),
        rotations=np.concatenate([motion.rotations, R], 1),
    )


def test_a_mapping_names_the_joints(body, own_motion, lengths, angles):
    motion = own_motion(lengths, angles)
    renamed = replace(motion, joints=tuple("Hips" if name == "root" else name for name in motion.joints))
    assert decompose(body, renamed, {}, None) is None
    assert decompose(body, renamed, {"root": "Hips"}, None) is not None


def _turned(motion, joint, angle, axis=0):
    """One joint turned about an axis that it has not."""
    j = motion.joints.index(joint)
    R = motion.rotations.copy()
    R[:, j] = R[:, j] @ Rotation.from_rotvec(angle * np.eye(3)[axis]).as_matrix()
    return replace(motion, rotations=R)


def _moved(motion, joint, metres):
    p = motion.positions_m.copy()
    p[7:, motion.joints.index(joint)] += (metres, 0, 0)
    return replace(motion, positions_m=p)


def test_what_the_body_cannot_do_is_not_called_exact(body, own_motion, lengths, angles):
    motion = own_motion(lengths, angles)
    assert decompose(body, motion, {}, None) is not None
    assert decompose(body, _turned(motion, "l_knee", 1e-4), {}, None) is None
    assert decompose(body, _turned(motion, "l_knee", 1e-7), {}, None) is not None
    assert decompose(body, _moved(motion, "head", 2e-3), {}, None) is None
    assert decompose(body, _moved(motion, "head", 5e-4), {}, None) is not None


def test_another_tree_is_not_called_exact(body, own_motion, lengths, angles):
    motion = own_motion(lengths, angles)
    parents = list(motion.parents)
    parents[motion.joints.index("head")] = motion.joints.index("l_clavicle")
    assert decompose(body, replace(motion, parents=tuple(parents)), {}, None) is None
    assert decompose(body, replace(motion, rotations=None), {}, None) is None
    gap = motion.positions_m.copy()
    gap[3, 5] = np.nan
    assert decompose(body, replace(motion, positions_m=gap), {}, None) is None


def test_angles_outside_the_limits_are_told(body, own_motion, lengths, angles):
    bent = angles | {"l_knee": np.full(FRAMES, 1.0)}
    found = retarget(body, own_motion(lengths, bent), fit_lengths=False)
    assert found.exact
    assert found.angles[:, body.dof_names.index("l_knee")] == pytest.approx(1.0, abs=1e-6)
    (remark,) = found.remarks
    assert "l_knee" in remark and f"{FRAMES} of {FRAMES} frames" in remark


@pytest.mark.parametrize("axes", [(0,), (2, 1), (1, 0, 2), (2, 0, 1), (2, 0, 2), (0, 1, 0)])
def test_turns_come_back_in_any_order(axes):
    rng, t = np.random.default_rng(0), np.arange(200) / 60
    # The first goes around several times; the others stay where the order is unique.
    values = np.stack([4 * t, *(0.7 + 0.5 * np.sin(rng.uniform(1, 5) * t + k) for k in range(len(axes) - 1))], axis=1)
    signs = [-1, 1, -1][: len(axes)]
    rotations = np.eye(3)
    for k, axis in enumerate(axes):
        rotations = rotations @ Rotation.from_rotvec(signs[k] * values[:, k, None] * np.eye(3)[axis]).as_matrix()
    limits = [-np.inf, -0.1, -3.0][: len(axes)], [np.inf, 1.5, 3.0][: len(axes)]
    found = angles_of(np.broadcast_to(rotations, (200, 3, 3)), axes, signs, *map(np.array, limits))
    assert found is not None
    assert np.abs(found.values - values - 2 * np.pi * np.round((found.values - values)[0] / (2 * np.pi))).max() < 1e-9
    assert found.residual.max() < 1e-9


def test_a_right_angle_in_the_middle_leaves_nothing():
    turn = Rotation.from_euler("ZXY", [0.3, np.pi / 2, 0.2]).as_matrix()[None]
    found = angles_of(turn, (2, 0, 1), (1, 1, 1), np.full(3, -4.0), np.full(3, 4.0))
    assert found is not None and found.residual.max() < 1e-6


def test_axes_that_repeat_are_refused():
    assert angles_of(np.eye(3)[None], (0, 0), (1, 1), np.zeros(2), np.ones(2)) is None
