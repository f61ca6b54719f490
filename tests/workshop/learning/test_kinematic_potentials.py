"""Kinematic potentials learned from captured motion: people and motions count alike, lengths do not matter, and other people's poses are likelier."""

from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from workshop.learning import quaternion_mixture

from bayes_body.base.geometry import rigid, rotations
from bayes_body.cli.main import main
from bayes_body.model.body.build import Shape, build_body
from bayes_body.model.definition import load_body
from bayes_body.model.potentials.joint_mixture import load_joint_mixtures
from bayes_body.recording.readers.mocap import read_motion
from bayes_body.workshop.learning.kinematic_potentials import Floors, JointPoses, held_out, joint_poses, joints_of, learn_joints, relative_poses
from bayes_body.workshop.learning.walking_cycle import load_cycle, walk

BODY, FPS = "person_31", 60.0
FLOORS = Floors(0.01, np.radians(2))
PARTS = ("head", "l_thigh", "l_calf", "r_thigh", "r_calf", "l_upper_arm", "l_forearm", "r_upper_arm", "r_forearm")
TRAIN = ("02", "05", "07", "08", "16")
# Of four other people; the walks of 39 are slow, fast and turning.
HELD_OUT = ("06_01", "35_02", "35_14", "35_30", "38_01", "38_02", "39_01", "39_05", "39_12")


@pytest.fixture(scope="module")
def schema():
    return load_body(BODY)


def _motion(subject, angle):
    """All joints bent by this angle about y."""
    turn = Rotation.from_rotvec([0, angle, 0]).as_quat(scalar_first=True)
    return JointPoses(f"{subject}_{angle}", subject, np.tile(np.concatenate([np.zeros(3), turn]), (10, len(PARTS), 1)))


def test_the_joints_are_those_of_the_parts(schema):
    parts, parents = joints_of(BODY, schema)
    assert set(parts) == set(PARTS)
    assert {part: parent for part, parent in zip(parts, parents, strict=True) if parent != "torso"} == {
        "l_calf": "l_thigh",
        "r_calf": "r_thigh",
        "l_forearm": "l_upper_arm",
        "r_forearm": "r_upper_arm",
    }


def test_people_and_their_motions_count_alike(schema):
    motions = [_motion("a", 0.2), _motion("a", 0.6), _motion("a", 0.7), _motion("b", 1.0)]
    found = learn_joints(motions, BODY, schema, 1, FLOORS)
    expected = (0.5 + 1.0) / 2
    np.testing.assert_allclose(rotations.logarithm(found.mean[:, 0, 3:])[:, 1], expected, atol=1e-9)
    variance = np.mean([np.mean([(angle - expected) ** 2 for angle in (0.2, 0.6, 0.7)]), (1.0 - expected) ** 2])
    np.testing.assert_allclose(found.covariance[:, 0, 1, 1, 1], variance, atol=1e-9)
    results = held_out(found, motions)
    assert results.subjects == ("a", "b") and results.values.shape == (2, len(PARTS))
    # The log-density of a rotation about one axis by one Gaussian, here in words of its own.
    away, floor = np.array([1.0 - expected]), FLOORS.rotation
    log_jacobian = np.log(2 * (1 - np.cos(away)) / away**2)
    closed = -3 * np.log(2 * np.pi) - 3 * np.log(0.01) - 2 * np.log(floor) - 0.5 * np.log(variance) - 0.5 * away**2 / variance - log_jacobian
    np.testing.assert_allclose(results.values[1], closed[0], atol=1e-6)


def test_relative_poses_do_not_depend_on_the_persons_size(schema):
    rng = np.random.default_rng(0)
    bodies = [build_body(BODY, schema, Shape(height)) for height in (1.55, 1.95)]
    angles = 0.3 * rng.normal(size=(5, len(bodies[0].dof_names)))
    small, tall = (relative_poses(body, angles) for body in bodies)
    assert np.abs(rotations.angle(rigid.relative(small, tall)[..., 3:])).max() < 1e-5
    # A thigh hangs on the torso itself; shoulders move with thorax and collar-bones, further in a tall person.
    parts, _ = joints_of(BODY, schema)
    moves = np.array([part in ("head", "l_upper_arm", "r_upper_arm") for part in parts])
    assert np.abs(small[:, ~moves, :3]).max() < 1e-6 and np.abs(small[:, moves, :3]).max() > 0.02
    np.testing.assert_allclose(tall[..., :3], small[..., :3] * 1.95 / 1.55, atol=1e-5)


def _write_trc(path, points):
    """A marker file of OpenSim, with y up, written by hand."""
    frames, names = len(points["pelvis"]), list(points)
    values = np.stack([points[name] for name in names], axis=1)[..., [1, 2, 0]] * 1000
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
    ]
    lines += [f"{FPS:g}\t{FPS:g}\t{frames}\t{len(names)}\tmm\t{FPS:g}\t1\t{frames}", "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t"]
    lines += ["\t\t" + "\t".join(f"{axis}{k + 1}" for k in range(len(names)) for axis in "XYZ"), ""]
    lines += [f"{t + 1}\t{t / FPS:.6f}\t" + "\t".join(f"{value:.3f}" for value in values[t].ravel()) for t in range(frames)]
    path.write_text("\n".join(lines) + "\n")


def _bend(points, frames):
    """Mean angle of the left knee, radians, by its three points."""
    hip, knee, ankle = (points[f"l_{name}"][frames] for name in ("hip", "knee", "ankle"))
    upper, lower = hip - knee, ankle - knee
    cosine = (upper * lower).sum(axis=1) / np.linalg.norm(upper, axis=1) / np.linalg.norm(lower, axis=1)
    return np.pi - np.arccos(cosine).mean()


@pytest.mark.long
@pytest.mark.usefixtures("optimised")
def test_the_command_learns_the_bend_of_a_knee(tmp_path, capsys):
    """Two walkers of landmarks, each in a folder, and a third one for the table."""
    points = {}
    for subject, (height, seed) in {"tall": (1.9, 1), "small": (1.6, 2), "third": (1.75, 3)}.items():
        points[subject] = walk(load_cycle(), 1.2, FPS, seed=seed, height_m=height, heading=0.4 * seed)
        (tmp_path / subject).mkdir()
        _write_trc(tmp_path / subject / "walk.trc", {name: points[subject][name] for name in _fifteen()})
    out = tmp_path / "mine.npz"
    words = ["learn", "kinematic-potentials", tmp_path / "tall", tmp_path / "small", "--components", "2", "--frames", "30", "--source", "made up"]
    with pytest.raises(SystemExit) as stopped:
        main([str(word) for word in [*words, "--held-out", tmp_path / "third", "--out", out]])
    said = capsys.readouterr()
    assert stopped.value.code == 0, said.err
    assert "log-density of 1 motions held out, nats a frame, mean of 1 people" in said.out
    assert "9 joints, 2 components each, from 2 motions of 2 people" in said.out.replace("\n", " ")
    rows = {line.split()[0]: line.split()[1:] for line in said.out.splitlines() if line.split() and line.split()[0] in (*PARTS, "all")}
    assert set(rows) == {*PARTS, "all"}
    assert float(rows["all"][0]) == pytest.approx(sum(float(rows[part][0]) for part in PARTS), abs=0.05)
    told = out.with_suffix(".toml").read_text()
    assert 'source = "made up"' in told and "--components 2 --frames 30 --held-out third --out mine.npz" in told and 'held_out = ["walk"]' in told
    joints = load_joint_mixtures(out)
    knee = joints.parts.index("l_calf")
    bend = joints.weight[knee] @ np.linalg.norm(rotations.logarithm(joints.mean[knee, :, 3:]), axis=1)
    frames = np.linspace(0, len(points["tall"]["pelvis"]) - 1, 30).round().astype(int)
    # The fit's smoothing and its limits move single frames by more.
    assert bend == pytest.approx(np.mean([_bend(points[subject], frames) for subject in ("tall", "small")]), abs=np.radians(3))
    # A knee and its calf are held by the length of the thigh, so their distance does not vary: the floor.
    np.testing.assert_allclose(np.linalg.eigvalsh(joints.covariance[knee, :, 0]), 0.01**2, rtol=1e-3)


def _fifteen():
    from bayes_body.recording.evidence.markers import MARKERS

    return MARKERS


def test_the_command_refuses_before_it_works(tmp_path, capsys):
    (tmp_path / "there.npz").write_bytes(b"")
    for options, said in (
        (("--out", tmp_path / "there.npz"), "already exists"),
        (("--out", tmp_path / "mine.zip"), "a file that ends in .npz"),
        (("--out", tmp_path / "mine.npz", "--floor-mm", "0"), "--floor-mm: 0; expected a finite number above 0; correct it"),
        (("--out", tmp_path / "mine.npz", "--floor-deg", "nan"), "--floor-deg: nan; expected a finite number above 0; correct it"),
        (("--out", tmp_path / "mine.npz"), "no captured motion in it"),
        (("--out", tmp_path / "mine.npz", "--body", "poon_fleet_23"), "a body whose parts have fixed sizes"),
    ):
        with pytest.raises(SystemExit) as stopped:
            main([str(word) for word in ("learn", "kinematic-potentials", tmp_path, *options)])
        assert stopped.value.code == 2
        assert said in capsys.readouterr().err.replace("\n", " ")


def test_what_ships_is_of_the_shipped_body(schema):
    joints = load_joint_mixtures("kinematic_10")
    assert (joints.parts, joints.parents) == joints_of(BODY, schema) and joints.weight.shape == (9, 4)
    sd = np.sqrt(np.linalg.eigvalsh(joints.covariance))
    assert sd[:, :, 0].min() >= 0.01 * (1 - 1e-3) and sd[:, :, 1].min() >= np.radians(2) * (1 - 1e-3)
    # No joint of a walker opens by more than this.
    assert sd[:, :, 0].max() < 0.1 and sd[:, :, 1].max() < np.radians(60)


@pytest.fixture(scope="module")
def clips(cmu_mocap, schema):
    @cache
    def of(name):
        motion = read_motion(cmu_mocap / name[:2] / f"{name}.amc")
        return joint_poses(name, name[:2], motion, BODY, schema, 60)

    return of


@pytest.mark.long
@pytest.mark.usefixtures("optimised")
def test_other_peoples_poses_are_likelier_than_by_one_gaussian_or_by_quaternions(cmu_mocap, clips, schema):
    """People whom nothing was learned from. The quaternions' density is normalised over rotations (`quaternion_mixture`)."""
    train = [clips(path.stem) for subject in TRAIN for path in sorted((cmu_mocap / subject).glob("*.amc"))]
    others = [clips(name) for name in HELD_OUT]
    ours, single = held_out(load_joint_mixtures("kinematic_10"), others), held_out(learn_joints(train, BODY, schema, 1, FLOORS), others)
    poses = np.concatenate([motion.poses for motion in train])
    weights = np.concatenate([np.full(60, 1 / (5 * 60 * sum(other.subject == motion.subject for other in train))) for motion in train])
    papers = [quaternion_mixture.fit(poses[:, joint], weights, 4, FLOORS) for joint in range(9)]
    assert max(found.error for found in papers) < 0.01
    each = np.array([[quaternion_mixture.log_density(found, motion.poses[:, j]).mean() for j, found in enumerate(papers)] for motion in others])
    subjects = np.array([motion.subject for motion in others])
    theirs = np.stack([each[subjects == person].mean(axis=0) for person in ours.subjects])
    print("\njoint, ours, one Gaussian, quaternions; then by person")
    for j, part in enumerate(joints_of(BODY, schema)[0]):
        print(part, *(np.round(values[:, j].mean(), 2) for values in (ours.values, single.values, theirs)), *np.round(ours.values[:, j], 2))
    print("all", *(np.round(values.sum(axis=1), 2) for values in (ours.values, single.values, theirs)))
    assert (ours.values.sum(axis=1) > single.values.sum(axis=1)).all()
    # No worse than the paper's form by more than a tenth of a nat for a joint.
    assert ours.values.sum(axis=1).mean() > theirs.sum(axis=1).mean() - 0.9
