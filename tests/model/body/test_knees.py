"""Knees of the bodies that ship bend forwards no further than healthy ones, and poses of real people are inside their limits."""

import numpy as np
import pytest

from bayes_body.model.body.build import build_body
from bayes_body.model.build import build_model
from bayes_body.model.definition import definition_names, load_body
from bayes_body.recording.readers.parsec import import_parsec

KNEES = ("l_knee", "r_knee")


def _degrees(skeleton, dof_names, side):
    return {name: float(np.degrees(getattr(skeleton, side)[dof_names.index(name)])) for name in KNEES if name in dof_names}


@pytest.mark.parametrize("name", [name for name in definition_names("bodies") if name not in ("arm_4", "sidenbladh_4")])
def test_a_knee_bends_forwards_by_five_to_ten_degrees(name):
    body = build_body(name, load_body(name))
    limits = _degrees(body.skeleton, body.dof_names, "high")
    assert set(limits) == set(KNEES)
    assert all(5 - 1e-3 <= limit <= 10 + 1e-3 for limit in limits.values())


def test_captured_people_stay_inside(cmu_mocap):
    """Flexion is positive in these files; the widest is a jump."""
    files = sorted(cmu_mocap.rglob("*.amc"))
    rows = [line.split() for file in files for line in file.read_text().splitlines() if line.startswith(("ltibia ", "rtibia "))]
    flexion = np.array([float(angle) for _, angle in rows])
    body = build_body("person_31", load_body("person_31"))
    low, high = (_degrees(body.skeleton, body.dof_names, side)["l_knee"] for side in ("low", "high"))
    assert len(files) > 0 and flexion.size > 1000
    assert -high < flexion.min() and flexion.max() < -low


def test_the_first_pose_of_a_real_recording_is_inside(bodytrack, tmp_path):
    session, _ = import_parsec(bodytrack, tmp_path)
    body, pose = (model := build_model("deutscher_2005", session)).body, np.asarray(model.initial["pose"])
    low, high = np.asarray(body.skeleton.low), np.asarray(body.skeleton.high)
    assert ((low <= pose) & (pose <= high)).all()
    assert all(pose[body.dof_names.index(name)] < high[body.dof_names.index(name)] for name in KNEES)
