"""The conventions of joint angles: round trips, movements of positive sign on both sides, Grood & Suntay's own definition, gimbal lock."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from bayes_body.model.body.build import build_body
from bayes_body.model.definition import load_body
from bayes_body.results.clinical.conventions import (
    ANKLE,
    ARM,
    CLINICAL,
    ELBOW,
    HIP,
    KNEE,
    LUMBAR,
    MIRROR,
    OPENSIM,
    PELVIS,
    SHOULDER,
    SUBTALAR,
    TALOCRURAL,
    WRIST,
    angles_of,
    opensim_conventions,
    rotation_of,
)
from bayes_body.results.clinical.joints import joint_frames, joints_of

ALL = (*OPENSIM, TALOCRURAL, SUBTALAR)
SIDED = [(convention, side) for convention in ALL for side in convention.sides]
FORWARD, UP, RIGHT = np.eye(3)


@pytest.mark.parametrize(("convention", "side"), SIDED, ids=[f"{convention.joint} {side}" for convention, side in SIDED])
@given(seed=st.integers(0, 2**32 - 1))
def test_round_trip(convention, side, seed):
    R = Rotation.random(50, rng=np.random.default_rng(seed)).as_matrix()
    angles = angles_of(convention, side, R)
    assert np.abs(rotation_of(convention, side, angles) - R).max() < 1e-6
    again = angles_of(convention, side, rotation_of(convention, side, angles))
    # Near gimbal lock two angles are ill-determined, though the rotation is not.
    middle = np.abs(np.sin(angles[:, 1]) if convention.sequence == "YXY" else np.cos(angles[:, 1]))
    assert np.abs(np.exp(1j * again) - np.exp(1j * angles))[middle > 1e-3].max() < 1e-6


@pytest.mark.parametrize("convention", ALL, ids=[convention.joint for convention in ALL])
def test_gimbal_lock_still_gives_the_rotation(convention):
    locked = 0.0 if convention.sequence == "YXY" else np.pi / 2
    R = rotation_of(convention, convention.sides[0], np.array([[0.3, locked, 0.4], [0.3, -locked, -0.4]]))
    assert np.abs(rotation_of(convention, convention.sides[0], angles_of(convention, convention.sides[0], R)) - R).max() < 1e-6


def turned(convention, side, angle, degrees):
    """The rotation with one angle, from the others at zero; for the shoulder from an arm that is raised a little to the side."""
    angles = np.zeros(3)
    angles[[each.name for each in convention.angles].index(angle)] = np.radians(degrees)
    return rotation_of(convention, side, angles)


@pytest.mark.parametrize("side", ["r", "l"])
def test_positive_values_are_the_movement_that_the_table_names(side):
    outward = RIGHT if side == "r" else -RIGHT
    # (joint, angle, a direction of the distal segment, where the movement brings it)
    movements = [
        (HIP, "hip_flexion", -UP, FORWARD),
        (HIP, "hip_adduction", -UP, -outward),
        (HIP, "hip_rotation", FORWARD, -outward),
        (KNEE, "knee_flexion", -UP, -FORWARD),
        (KNEE, "knee_adduction", -UP, -outward),
        (KNEE, "knee_rotation", FORWARD, -outward),
        (ANKLE, "ankle_dorsiflexion", FORWARD, UP),
        (ANKLE, "ankle_inversion", -UP, -outward),
        (ARM, "arm_flexion", -UP, FORWARD),
        (ARM, "arm_adduction", -UP, -outward),
        (ARM, "arm_rotation", FORWARD, -outward),
        (SHOULDER, "shoulder_elevation", -UP, outward),
        (SHOULDER, "shoulder_rotation", FORWARD, -outward),
        (ELBOW, "elbow_flexion", -UP, FORWARD),
        (ELBOW, "forearm_pronation", FORWARD, -outward),
        # The little finger's side of a hanging hand, palm forward, is the inner one.
        (WRIST, "wrist_deviation", -UP, -outward),
    ]
    for convention, angle, before, after in movements:
        assert turned(convention, side, angle, 30) @ before @ after == pytest.approx(0.5, abs=1e-9), angle


def test_positive_values_of_the_trunk():
    assert turned(PELVIS, "", "pelvic_tilt", 30) @ UP @ FORWARD == pytest.approx(0.5)
    assert turned(PELVIS, "", "pelvic_obliquity", 30) @ RIGHT @ UP == pytest.approx(0.5)
    assert turned(PELVIS, "", "pelvic_rotation", 30) @ FORWARD @ -RIGHT == pytest.approx(0.5)
    assert turned(LUMBAR, "", "lumbar_extension", 30) @ UP @ -FORWARD == pytest.approx(0.5)
    assert turned(LUMBAR, "", "lumbar_bending", 30) @ UP @ RIGHT == pytest.approx(0.5)
    assert turned(LUMBAR, "", "lumbar_rotation", 30) @ FORWARD @ -RIGHT == pytest.approx(0.5)


def test_opensim_s_coordinates_of_a_body_with_a_talus_are_its_angles():
    """And about an oblique axis the angles of the foot on the shank change together."""
    schema = load_body("person_35")
    body = build_body("person_35", schema)
    joints = joints_of(body, schema.clinical, (1, 2, 0), opensim_conventions(schema.clinical))
    assert not {f"ankle_{name}_r" for name in ("dorsiflexion", "inversion", "rotation")} & {name for joint in joints for name in joint.names}
    angles = {"r_ankle_y": 0.2, "r_subtalar": -0.3, "l_ankle_y": -0.4, "l_subtalar": 0.25, "l_knee": -0.6, "root_yaw": 2.0}
    pose = np.array([[angles.get(name, 0.1) for name in body.dof_names]])
    rotations = np.asarray(joint_frames(body, pose).rotation, float)
    values = {}
    for joint in joints:
        values |= dict(zip(joint.coordinates, joint.angles(rotations)[0], strict=True))
    for side in "lr":
        assert values[f"ankle_angle_{side}"] == pytest.approx(angles[f"{side}_ankle_y"], abs=1e-5)
        assert values[f"subtalar_angle_{side}"] == pytest.approx(angles[f"{side}_subtalar"], abs=1e-5)
    ankle = next(joint for joint in joints_of(body, schema.clinical, (1, 2, 0), (ANKLE,)) if joint.side == "l")
    assert ankle.names == ("ankle_dorsiflexion_l", "ankle_inversion_l", "ankle_rotation_l")
    assert (ankle.angles(rotations)[0][1:] > 0.1).all()
    assert opensim_conventions(load_body("person_40").clinical) is OPENSIM


def test_the_planes_of_the_shoulder():
    for side, outward in (("r", RIGHT), ("l", -RIGHT)):
        for plane, direction in ((0, outward), (90, FORWARD)):
            R = rotation_of(SHOULDER, side, np.radians([plane, 90, 20]))
            assert R @ -UP @ direction == pytest.approx(1)
            assert np.degrees(angles_of(SHOULDER, side, R)) == pytest.approx([plane, 90, 20])


def test_a_mirrored_movement_has_the_same_numbers():
    R = Rotation.random(20, rng=np.random.default_rng(1)).as_matrix()
    for convention in (HIP, KNEE, SHOULDER, ELBOW):
        np.testing.assert_allclose(angles_of(convention, "l", MIRROR @ R @ MIRROR), angles_of(convention, "r", R), atol=1e-9)


def test_the_knee_is_grood_and_suntay_s():
    """By the vectors of their paper: e1 the femur's z, e3 the tibia's y, and the common perpendicular, which floats."""
    R = Rotation.from_euler("ZXY", np.random.default_rng(2).uniform(-1, 1, (50, 3))).as_matrix()
    flexion, adduction, internal = angles_of(KNEE, "r", R).T
    y, z = R[:, :, 1], R[:, :, 2]
    floating = np.cross(y, RIGHT)
    floating /= np.linalg.norm(floating, axis=1, keepdims=True)
    np.testing.assert_allclose(-floating @ UP, np.sin(flexion), atol=1e-9)
    np.testing.assert_allclose(y @ RIGHT, np.sin(adduction), atol=1e-9)
    np.testing.assert_allclose(np.einsum("na,na->n", floating, z), np.sin(internal), atol=1e-9)


def test_the_guide_has_every_angle_and_its_sign():
    guide = (Path(__file__).parents[3] / "docs" / "guide" / "clinical_angles.md").read_text(encoding="utf-8")
    for convention in CLINICAL:
        assert f"{' '.join(convention.sequence)} (" in guide
        for angle in convention.angles:
            opensim = f"`{angle.opensim}`" if angle.opensim else ""
            assert f"| `{angle.name}` | {angle.positive} | {angle.negative} | {opensim} |".replace("|  |", "| |") in guide
