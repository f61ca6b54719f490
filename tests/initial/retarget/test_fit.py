"""Landmarks of people that the body knows nothing of, fitted: how near, how smooth, and what is left out."""

import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.initial.retarget import retarget
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.readers.mocap import landmarks, read_motion, resample
from bayes_body.recording.readers.truth import read_truth
from bayes_body.results.clinical.joints import joint_frames
from bayes_body.workshop.learning.walking_cycle import load_cycle, walk

# Fits and replications run for longer than they compile.
pytestmark = pytest.mark.usefixtures("optimised")

FPS = 60.0
# The first walk of every subject of the set, and the most that its markers may lie off on average, mm: two skeletons are never the same.
SUBJECTS = {"02": "02_01", "05": "05_01", "06": "06_01", "07": "07_01", "08": "08_01", "16": "16_15", "35": "35_01", "38": "38_01", "39": "39_01"}
# Two people in every run; the others are long.
FEW = ("06", "35")
MOST_MM = 8.0
# Of an angle between frames, rad: a flip would be near pi.
STEP = 0.5


@pytest.fixture(scope="module")
def walker():
    """A second of a walk, turned, with a wrist lost for ten frames and the crown never seen."""
    points = walk(load_cycle(), 1.0, FPS, heading=2.0, start=(3.0, -1.0), height_m=1.62)
    points["r_wrist"] = points["r_wrist"].copy()
    points["r_wrist"][20:30] = np.nan
    points["head"] = np.full_like(points["head"], np.nan)
    return points


@pytest.fixture(scope="module")
def fitted(body, walker):
    return retarget(body, walker, FPS)


@pytest.mark.long
def test_a_walk_is_fitted_to_millimetres(fitted, walker):
    assert not fitted.exact
    assert fitted.angles.shape == (60, 31)
    assert fitted.residual().mean_mm < 8
    assert fitted.residual().max_mm < 40
    measured = np.linalg.norm(fitted.markers_m[:, 9] - walker["l_knee"], axis=1)
    assert fitted.marker_names[9] == "l_knee" and np.allclose(measured, fitted.residual_m[:, 9])


@pytest.mark.long
def test_lengths_become_the_persons(fitted, walker):
    for name, a, b in (("l_thigh", "l_hip", "l_knee"), ("r_calf", "r_knee", "r_ankle"), ("l_upper_arm", "l_shoulder", "l_elbow")):
        true = np.linalg.norm(walker[a] - walker[b], axis=1).mean()
        assert fitted.lengths_m[name] == pytest.approx(true, abs=0.008)


@pytest.mark.long
def test_what_is_unknown_is_left_out_and_the_rest_stays(fitted):
    names = list(fitted.marker_names)
    wrist, head = names.index("r_wrist"), names.index("head")
    assert np.isnan(fitted.residual_m[20:30, wrist]).all() and np.isfinite(fitted.residual_m[:20, wrist]).all()
    assert np.isnan(fitted.residual_m[:, head]).all()
    assert np.isnan(fitted.residual("head").mean_mm)
    assert np.isfinite(fitted.angles).all()


@pytest.mark.long
def test_angles_are_inside_their_limits_and_do_not_jump(fitted, body):
    low, high = np.asarray(body.skeleton.low), np.asarray(body.skeleton.high)
    assert ((fitted.angles >= low) & (fitted.angles <= high)).all()
    assert np.abs(np.diff(fitted.angles[:, 3:], axis=0)).max() < STEP
    assert fitted.remarks == ()


@pytest.mark.long
def test_the_knee_bends_as_the_landmarks_do(fitted, walker):
    thigh, shank = walker["l_knee"] - walker["l_hip"], walker["l_ankle"] - walker["l_knee"]
    true = np.arccos((thigh * shank).sum(1) / np.linalg.norm(thigh, axis=1) / np.linalg.norm(shank, axis=1))
    knee = -fitted.angles[:, fitted.body.dof_names.index("l_knee")]
    assert np.abs(knee - true).max() < 0.2
    assert np.corrcoef(knee, true)[0, 1] > 0.99


def bend(points, *names):
    """The angle between two segments that follow each other, rad."""
    a, b, c = (np.asarray(points[name]) for name in names)
    return np.arctan2(np.linalg.norm(np.cross(b - a, c - b), axis=1), ((b - a) * (c - b)).sum(axis=1))


@pytest.mark.long
@pytest.mark.parametrize("seed", range(8))
def test_the_pelvis_stays_below_the_spine(body, seed):
    """The landmarks do not tell the pelvis's tilt about the hips' axis. It must not drift: with Adam it did, by 15 degrees a second."""
    points = walk(load_cycle(), 1.0, FPS, seed=seed)
    fitted = retarget(body, points, FPS)
    placed = dict(zip(fitted.marker_names, np.moveaxis(fitted.markers_m, 1, 0), strict=True))
    for names, most_deg in (
        (("thorax", "pelvis", "l_knee"), 4),
        (("thorax", "pelvis", "r_knee"), 4),
        (("l_hip", "l_knee", "l_ankle"), 6),
        (("r_hip", "r_knee", "r_ankle"), 6),
    ):
        assert np.abs(bend(placed, *names) - bend(points, *names)).max() < np.radians(most_deg), names
    spine, true_spine = (each["thorax"] - each["pelvis"] for each in (placed, points))
    lean, true_lean = (np.arctan2(np.linalg.norm(each[:, :2], axis=1), each[:, 2]) for each in (spine, true_spine))
    assert np.abs(lean - true_lean).max() < np.radians(2)
    up = np.asarray(joint_frames(fitted.body, jnp.asarray(fitted.angles, jnp.float32)).rotation)[:, 0, :, 2]
    between = np.arctan2(np.linalg.norm(np.cross(up, spine), axis=1), (up * spine).sum(axis=1))
    assert between.max() < np.radians(9)


@pytest.mark.parametrize(
    ("points", "fps", "parts"),
    [
        ({"l_hip": np.zeros((5, 3)), "nose": np.zeros((5, 3))}, FPS, ["l_hip of the body's points", "at least 4"]),
        ({}, FPS, ["no frame"]),
        ({name: np.full((5, 3), np.nan) for name in MARKERS}, FPS, ["at least 4"]),
        ({name: np.zeros((5, 3)) for name in MARKERS}, None, ["fps", "above 0"]),
        ({name: np.zeros((5, 3)) for name in MARKERS}, float("nan"), ["fps", "nan"]),
        ({"l_hip": np.zeros((5, 3)), "r_hip": np.zeros((4, 3))}, FPS, ["r_hip", "4 frames", "5"]),
    ],
)
def test_too_little_to_go_by_is_a_sentence(body, points, fps, parts):
    with pytest.raises(InputError) as caught:
        retarget(body, points, fps)
    assert all(part in str(caught.value) for part in parts)


@pytest.mark.long
def test_kept_lengths_stay(body, walker):
    found = retarget(body, walker, FPS, fit_lengths=False)
    assert found.lengths_m == {}
    assert np.array_equal(found.body.lengths, body.lengths)
    # A person of 1.62 m in a body of 1.75 m.
    assert found.residual().mean_mm > 12


@pytest.mark.long
@pytest.mark.parametrize("subject", [subject if subject in FEW else pytest.param(subject, marks=pytest.mark.long) for subject in SUBJECTS])
def test_walks_of_real_people_fit_without_flips(body, cmu_mocap, subject):
    motion = resample(read_motion(cmu_mocap / subject / f"{SUBJECTS[subject]}.amc"), FPS)
    found = retarget(body, motion)
    jump = np.abs(np.diff(found.angles[:, 3:], axis=0)).max()
    print(f"{subject}: {len(found.angles)} frames, {found.residual()}, largest step {jump:.2f} rad")
    assert found.residual().mean_mm < MOST_MM
    assert jump < STEP


@pytest.mark.long
def test_the_command_writes_a_truth_that_is_read(command, cmu_mocap, tmp_path):
    out = tmp_path / "motion.npz"
    status, told, _ = command("mocap", cmu_mocap / "02" / "02_02.amc", "--fps", 60, "--out", out)
    assert status == 0
    assert "31 dofs of deutscher_31, 149 frames at 60 a second, fitted" in told and "l_knee" in told and "lengths: torso" in told
    motion = landmarks(resample(read_motion(cmu_mocap / "02" / "02_02.amc"), FPS))
    assert np.allclose(read_truth(out, 149), np.stack([motion[name] for name in MARKERS], 1))
    with np.load(out) as file:
        assert file["angles"].shape == (149, 31) and list(file["dof_names"])[:3] == ["root_x", "root_y", "root_z"]
        assert file["fps"] == 60 and str(file["body"]) == "deutscher_31" and not file["exact"]


def test_the_command_refuses_in_sentences(command, tmp_path):
    there = tmp_path / "there.npz"
    there.write_bytes(b"")
    for arguments, part in (
        (("walk.amc", "--out", tmp_path / "m.trc"), "ends in .npz"),
        (("walk.amc", "--out", there), "--overwrite"),
        (("walk.amc", "--out", tmp_path / "m.npz", "--height", 180), "between 0.5 and 2.8"),
        (("walk.amc", "--out", tmp_path / "m.npz", "--body", "deutscher_32"), "deutscher_31"),
        ((tmp_path / "none.amc", "--out", tmp_path / "m.npz"), "none.amc"),
        ((tmp_path / "none.fbx", "--out", tmp_path / "m.npz"), ".bvh"),
    ):
        status, _, err = command("mocap", *arguments)
        assert status == 2, err
        assert part in err and "Traceback" not in err
