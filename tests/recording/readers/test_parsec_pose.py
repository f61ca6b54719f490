"""The first pose of PARSEC's bodytrack, against the format's own chain of frames written out here in numpy, and against the pictures."""

from typing import NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.base.toml.read import read_toml
from bayes_body.model.body.build import Shape, build_body
from bayes_body.model.body.schema import BodySchema
from bayes_body.model.body.solids import Body, part_transforms
from bayes_body.recording.observation.frames import read_frame
from bayes_body.recording.readers.parsec import import_parsec
from bayes_body.recording.readers.parsec_subject import DOFS, LIMBS, PARTS, canonical_hinges
from bayes_body.recording.session.session import Session

# The format's presets, as it has them.
X90 = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
X180 = np.diag([1.0, -1, -1])
X270 = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
Y90 = np.array([[0, 0, -1.0], [0, 1, 0], [1, 0, 0]])
Y180 = np.diag([-1.0, 1, -1])
Z180 = np.diag([-1.0, -1, 1])


class Subject(NamedTuple):
    """A session of the real recording and the body of its subject, in double precision."""

    session: Session
    body: Body

    def ends(self, pose: dict[str, float]) -> dict[str, np.ndarray]:
        """(base, tip) of each part, (2, 3), metres."""
        with jax.enable_x64(True):
            T = part_transforms(self.body, jnp.array([pose[name] for name in self.body.dof_names]))
            ends = np.stack([T.origin, T.origin + self.body.lengths[:, None] * T.z], axis=1)
        return dict(zip(self.body.topology.names, ends, strict=True))


@pytest.fixture
def subject(bodytrack, tmp_path, deutscher) -> Subject:
    """The real recording's."""
    session, _ = import_parsec(bodytrack, tmp_path)
    known = session.subject
    with jax.enable_x64(True):
        shape = Shape(None, known.lengths_m, known.radii_m, known.sections)
        return Subject(session, build_body("deutscher_31", BodySchema.model_validate(read_toml(deutscher)), shape))


def turn(a: float, b: float, c: float) -> np.ndarray:
    """The format's R(a, b, c) = Rz(c) Rx(a) Ry(b)."""
    x, y, z = (cv2.Rodrigues(angle * axis)[0] for angle, axis in zip((a, b, c), np.eye(3), strict=True))
    return z @ x @ y


def chain(pose: np.ndarray, length: np.ndarray) -> dict[str, np.ndarray]:
    """(base, tip) of each part, (2, 3), mm, from the numbers of InitialPose.txt and the lengths of BodyShapeParameters.txt."""
    ends = {}

    def move(R, p, *rotations, by=(0, 0, 0)):
        for rotation in rotations:
            R = R @ rotation
        return R, p + R @ np.array(by)

    def limb(upper, lower, R, p, hinge, l_upper, l_lower):
        R_hinge, p_hinge = R @ turn(0, hinge, 0).T, p + R[:, 2] * l_upper
        ends[upper] = np.stack([p, p_hinge])
        ends[lower] = np.stack([p_hinge, p_hinge + R_hinge[:, 2] * l_lower])

    root = turn(*pose[:3]), pose[3:6]
    ends["torso"] = np.stack([root[1], root[1] + root[0][:, 2] * length[0]])
    for side, k, y, n in (("l", 6, length[1], 2), ("r", 10, -length[5], 6)):
        R, p = move(*root, Y180, by=(0, y, 0))
        limb(f"{side}_thigh", f"{side}_calf", R @ turn(*pose[k : k + 3]).T, p, pose[k + 3], length[n], length[n + 1])
    thorax = move(*root, X180, turn(0, pose[26], pose[27]).T, by=(0, 0, -length[0]))
    for side, k, preset, n in (("l", 14, X90, 9), ("r", 20, X270, 13)):
        R, p = move(*thorax, preset, turn(pose[k], pose[k + 1], 0).T, by=(0, 0, -length[n]))
        R = R @ X90 @ Z180 @ Y90 @ turn(*pose[k + 2 : k + 5]).T
        limb(f"{side}_upper_arm", f"{side}_forearm", R, p, pose[k + 5], -length[n + 1], -length[n + 2])
    R, p = move(*thorax, X180, turn(*pose[28:31]).T)
    ends["head"] = np.stack([p, p + R[:, 2] * length[17]])
    return ends


def test_equals_the_formats_own_chain(subject, bodytrack):
    pose = np.array((bodytrack / "InitialPose.txt").read_text().split(), float)
    lengths = np.array((bodytrack / "BodyShapeParameters.txt").read_text().split(), float)[40:]
    expected = chain(pose, lengths)
    found = subject.ends(subject.session.initial)
    assert set(found) == set(expected) == set(PARTS)
    for part in PARTS:
        np.testing.assert_allclose(found[part], expected[part] / 1000, atol=1e-6, err_msg=part)


def test_hinges_turned_keep_the_picture(subject, bodytrack):
    numbers = np.array((bodytrack / "InitialPose.txt").read_text().split(), float)
    numbers[3:6] /= 1000
    written, turned = dict(zip(DOFS, numbers.tolist(), strict=True)), subject.session.initial
    assert sum(written[hinge] > 0 for hinge, _, _ in LIMBS) == 3
    assert all(turned[hinge] <= 0 for hinge, _, _ in LIMBS)
    before, after = subject.ends(written), subject.ends(turned)
    for part in PARTS:
        np.testing.assert_allclose(before[part], after[part], atol=1e-6, err_msg=part)


def test_initial_pose_is_within_the_bodys_limits(subject):
    # A prior that excludes it would start with no density at all.
    start = np.array([subject.session.initial[name] for name in subject.body.dof_names])
    assert np.all((np.asarray(subject.body.skeleton.low) < start) & (start < np.asarray(subject.body.skeleton.high)))


def test_initial_pose_covers_the_man(subject):
    # What the format's chain cannot show: cameras and pose are of one world.
    frame = read_frame(subject.session, 0)
    points = np.concatenate([base + np.outer((0.25, 0.5, 0.75), tip - base) for base, tip in subject.ends(subject.session.initial).values()])
    for view, mask in zip(subject.session.views, frame.masks or (), strict=True):
        spec = view.camera
        K = np.array([[spec.focal_px[0], 0, spec.centre_px[0]], [0, spec.focal_px[1], spec.centre_px[1]], [0, 0, 1]])
        pixels, _ = cv2.projectPoints(points, cv2.Rodrigues(spec.rotation)[0], spec.translation_m, K, np.array(spec.distortion))
        column, row = np.rint(pixels[:, 0]).astype(int).T
        assert mask[row, column].mean() > 0.9


def test_the_twist_takes_the_turn_that_lands_nearer_zero():
    pose = dict.fromkeys(DOFS, 0.0) | {"l_knee": 0.5, "l_hip_z": -2.0, "r_elbow": 0.25, "r_shoulder_z": 1.0}
    turned, remarks = canonical_hinges(pose, dict.fromkeys(PARTS, (1.0, 1.0)))
    assert (turned["l_knee"], turned["r_elbow"]) == (-0.5, -0.25)
    assert turned["l_hip_z"] == pytest.approx(np.pi - 2)
    assert turned["r_shoulder_z"] == pytest.approx(1 - np.pi)
    assert [remark.split()[1] for remark in remarks] == ["l_knee", "r_elbow"]


def test_an_elliptical_limb_is_left_alone():
    pose = dict.fromkeys(DOFS, 0.1)
    sections = dict.fromkeys(PARTS, (1.0, 1.0))
    turned, remarks = canonical_hinges(pose, sections | {"l_calf": (1.0, 0.9)})
    assert turned["l_knee"] == 0.1
    assert turned["l_hip_z"] == 0.1
    assert turned["r_knee"] == -0.1
    assert turned["r_hip_z"] == pytest.approx(0.1 - np.pi)
    assert len(remarks) == 3
