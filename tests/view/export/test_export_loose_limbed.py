"""Exports of a body that is placed by its parts: the same markers as the body by angles in every format, and the parts where the markers are."""

import csv
import itertools

import ezc3d
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bayes_body.results.storage.saved_run import load_run
from bayes_body.view.export.formats import export

MARKERS, MOMENTS, AXES = ("l_shoulder", "l_elbow", "l_wrist"), ("mean", "sd", "q05", "q95"), "xyz"
# Micrometres: what 32 bits hold of two metres, and the last digit of a file.
CLOSE_M = 3e-6


@pytest.fixture
def exported(make_run, tmp_path):
    """`exported("trc", pose=...)`: the files of the same poses, by angles and by parts; the second is the loose-limbed body's."""
    number = itertools.count()

    def call(name, up="z", **arrays):
        run = next(number)
        found = []
        for parts in (False, True):
            out = tmp_path / f"{run}_{'parts' if parts else 'angles'}.{name}"
            with load_run(make_run(out.name, parts=parts, **arrays)) as saved:
                export(saved, name, tmp_path / "out" / out.name, up=up)
            found.append(tmp_path / "out" / out.name)
        return found

    return call


def columns(path):
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}


def still_poses():
    """Poses that all draws of a frame share, radians (chain, draw, frame, dof)."""
    return np.broadcast_to(np.random.default_rng(5).uniform(-1.2, -0.2, (5, 4)), (2, 30, 5, 4))


def test_trc(exported):
    files = exported("trc")
    for moment in MOMENTS:
        paths = [path if moment == "mean" else path.with_stem(f"{path.stem}_{moment}") for path in files]
        lines = [path.read_text(encoding="utf-8").splitlines() for path in paths]
        assert lines[0][1:5] == lines[1][1:5]
        tables = [np.array([[float(cell) for cell in line.split("\t")] for line in text[6:]]) for text in lines]
        assert tables[1].shape == (5, 2 + 9)
        np.testing.assert_allclose(tables[1], tables[0], atol=1000 * CLOSE_M)


@pytest.mark.slow
def test_c3d(exported):
    by_angles, by_parts = (ezc3d.c3d(str(path)) for path in exported("c3d"))
    assert by_parts["parameters"]["POINT"]["LABELS"]["value"] == [*MARKERS]
    np.testing.assert_allclose(by_parts["data"]["points"], by_angles["data"]["points"], atol=1000 * CLOSE_M)


@pytest.mark.slow
def test_npz(exported):
    by_angles, by_parts = (np.load(path) for path in exported("npz"))
    for moment in MOMENTS:
        np.testing.assert_allclose(by_parts[f"marker_{moment}_m"], by_angles[f"marker_{moment}_m"], atol=CLOSE_M)
    assert by_parts["part_names"].tolist() == ["upper_arm", "forearm"] and not by_parts["angle_names"].size and not by_parts["shift_names"].size
    # The forearm's origin is the elbow.
    for moment in MOMENTS:
        np.testing.assert_allclose(by_parts[f"part_{moment}_m"][:, 1], by_angles[f"marker_{moment}_m"][:, 1], atol=CLOSE_M)
    np.testing.assert_allclose(np.linalg.norm(by_parts["part_quaternion_mean"], axis=-1), 1, atol=1e-6)
    assert {name for name in by_parts if name.startswith("part_rotation")} == {f"part_rotation_{moment}_deg" for moment in MOMENTS[1:]}


@pytest.mark.parametrize("up", ["z", *(pytest.param(up, marks=pytest.mark.slow) for up in "yx")])
def test_csv_places_the_parts_in_the_axes_of_the_file(exported, up):
    by_angles, by_parts = (columns(path) for path in exported("csv", up, pose=still_poses()))
    markers = [name for name in by_parts if name.startswith("l_")]
    # The elbow of the tree and that between two free parts are read in the same convention; only the parts can leave the hinge.
    np.testing.assert_allclose(by_parts["elbow_flexion_l_mean_deg"], by_angles["elbow_flexion_l_mean_deg"], atol=1e-3)
    np.testing.assert_allclose(by_angles["elbow_flexion_l_mean_deg"], -by_angles["elbow_mean_deg"], atol=1e-3)
    clinical = [name for name in by_parts if name.startswith(("elbow_", "forearm_"))]
    assert len(clinical) == 3 * 4
    assert len(markers) == 3 * 3 * 4
    for name in markers:
        np.testing.assert_allclose(by_parts[name], by_angles[name], atol=CLOSE_M)
    # A loose-limbed body has no angles: a part has an origin, a quaternion, and the spread of its rotation, with its unit at the end of each name.
    own = [name for name in by_parts if name.startswith("part_upper_arm_")]
    assert len(own) == 3 * 4 + 4 + 3 * 3 and {name.rsplit("_", 1)[1] for name in own} == {"m", "1", "deg"}
    assert len(by_parts) == 3 + 3 * 3 * 4 + 2 * len(own) + len(clinical)

    def entries(part, names, unit):
        return np.stack([by_parts[f"part_{part}_{name}_mean_{unit}"] for name in names], axis=-1)

    elbow, wrist = (np.stack([by_parts[f"{marker}_{axis}_mean_m"] for axis in AXES], axis=-1) for marker in ("l_elbow", "l_wrist"))
    np.testing.assert_allclose(entries("forearm", AXES, "m"), elbow, atol=CLOSE_M)
    turn = Rotation.from_quat(entries("forearm", ("qw", "qx", "qy", "qz"), "1"), scalar_first=True)
    # With SciPy's rotations: the wrist is on the forearm's z axis.
    length = np.linalg.norm(wrist - elbow, axis=-1)
    np.testing.assert_allclose(elbow + turn.apply(np.array([0, 0, 1])) * length[:, None], wrist, atol=CLOSE_M)


def test_the_spread_of_a_rotation_is_that_of_the_angle(exported):
    """Only the elbow bends: the forearm turns about its own y axis by as much, and the upper arm does not."""
    pose = np.zeros((2, 30, 5, 4))
    pose[..., 3] = np.random.default_rng(6).normal(-1, 0.2, (2, 30, 5))
    by_angles, by_parts = (columns(path) for path in exported("csv", "y", pose=pose))
    mean = by_angles["elbow_mean_deg"]
    np.testing.assert_allclose(by_parts["part_forearm_ry_sd_deg"], by_angles["elbow_sd_deg"], atol=1e-3)
    for moment in ("q05", "q95"):
        np.testing.assert_allclose(by_parts[f"part_forearm_ry_{moment}_deg"], by_angles[f"elbow_{moment}_deg"] - mean, atol=1e-3)
    still = [f"part_forearm_r{axis}_sd_deg" for axis in "xz"] + [f"part_upper_arm_r{axis}_sd_deg" for axis in AXES]
    assert max(by_parts[name].max() for name in still) < 0.05


@pytest.mark.slow
def test_a_quaternion_does_not_change_its_sign_on_the_way(exported):
    pose = np.zeros((2, 30, 5, 4))
    pose[..., 2] = np.linspace(-1.5, 1.5, 5)
    path = exported("npz", pose=pose)[1]
    q = np.load(path)["part_quaternion_mean"]
    assert (np.sum(q[1:] * q[:-1], axis=-1) > 0.8).all()
