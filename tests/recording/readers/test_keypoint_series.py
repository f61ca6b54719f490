"""The subject's keypoints in all frames: followed among several people, kept beside the session, and read again."""

import random

import cv2
import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.base.files import arrays_file
from bayes_body.recording.readers.keypoints import series as keypoint_series
from bayes_body.recording.readers.keypoints.candidates import Bystanders, Candidates
from bayes_body.recording.readers.keypoints.openpose import LAYOUTS
from bayes_body.recording.readers.keypoints.series import KeypointSeries, follow_person, read_series, write_series
from bayes_body.recording.session.session import CameraSpec

NAMES = ("neck", "mid_hip", "l_knee", "nose")


def series(frames=5, first=3) -> KeypointSeries:
    points = np.random.default_rng(0).uniform(0, 500, (frames, len(NAMES), 3))
    points[..., 2] = np.linspace(0.1, 1.0, len(NAMES))
    points[2, 1] = np.nan, np.nan, 0.0
    return KeypointSeries(points, NAMES, first)


def test_what_is_written_is_read(tmp_path):
    path, written = tmp_path / "deep" / "a.npz", series()
    write_series(path, written)
    found = read_series(path)
    assert (found.names, found.first) == (NAMES, 3)
    np.testing.assert_allclose(found.keypoints, written.keypoints, rtol=1e-6)
    assert set(found.frame(3)) == {"thorax", "pelvis", "l_knee", "nose"}
    assert set(found.frame(5)) == {"thorax", "l_knee", "nose"}
    assert found.frame(4)["l_knee"] == pytest.approx(tuple(written.keypoints[1, 2]), rel=1e-6)
    assert found.frame(2) == found.frame(8) == found.frame(-1) == {}
    # A file that is replaced is read anew.
    write_series(path, written._replace(first=100))
    assert read_series(path).first == 100


GOOD = {"keypoints": np.full((2, 2, 3), 0.5), "names": np.array(["nose", "l_knee"])}
CROWD = GOOD | {
    "candidates": np.full((2, 2, 2, 3), 0.5),
    "shares": np.full((2, 2), 0.4),
    "bystanders": np.full((3, 2, 3), 0.5),
    "bystander_counts": np.array([1, 2]),
}
CROWD_OF_NINE = {key: np.repeat(CROWD[key][:1], 9, axis=0) for key in ("keypoints", "candidates", "shares")} | {
    key: CROWD[key] for key in ("names", "bystanders")
}
FAULTS = {
    "no keypoints": ({"names": GOOD["names"]}, "no `keypoints`; expected an .npz with `keypoints`"),
    "no names": ({"keypoints": GOOD["keypoints"]}, "no `names`"),
    "other names": (GOOD | {"names": np.array(["nose"])}, r"keypoints: float64 of shape \(2, 2, 3\); expected numbers of shape \(frame, 1, 3\)"),
    "a name twice": (GOOD | {"names": np.array(["neck", "thorax"])}, "names: 'thorax' twice; expected unique names of the keypoints"),
    "numbers for names": (GOOD | {"names": np.arange(2)}, "names: int64 of shape"),
    "objects": (GOOD | {"names": np.array(["a", None], object)}, "names: .*object"),
    "percent": (GOOD | {"keypoints": np.full((2, 2, 3), 80.0)}, "a confidence of 80; expected 0 to 1"),
    "far away": (GOOD | {"keypoints": np.full((2, 2, 3), [1e7, 0, 0.5])}, "far outside any image"),
    "infinite": (GOOD | {"keypoints": np.full((2, 2, 3), [np.inf, 0, 0.5])}, "far outside any image"),
    "candidates alone": (GOOD | {"candidates": np.zeros((2, 1, 2, 3))}, "no `shares`; expected `candidates` and `shares`, or neither"),
    "candidates of three frames": (
        CROWD | {"candidates": np.zeros((3, 2, 2, 3))},
        r"candidates: float64 of shape \(3, 2, 2, 3\); expected numbers of",
    ),
    "candidates of words": (CROWD | {"candidates": np.full((2, 2, 2, 3), "a")}, "candidates: <U1 of shape"),
    "candidates far away": (CROWD | {"candidates": np.full((2, 2, 2, 3), [np.inf, 0, 0.5])}, "candidates: a keypoint far outside any image"),
    "shares of one candidate": (CROWD | {"shares": np.zeros((2, 1))}, r"shares: float64 of shape \(2, 1\); expected numbers of shape \(2, 2\)"),
    "shares above 1": (CROWD | {"shares": np.full((2, 2), 0.6)}, "shares: negative, or more than 1 in a frame"),
    "negative shares": (CROWD | {"shares": np.full((2, 2), -0.1)}, "shares: negative"),
    "unknown shares": (CROWD | {"shares": np.full((2, 2), np.nan)}, "shares: negative, or more than 1 in a frame"),
    "uncounted bystanders": (GOOD | {"bystanders": np.zeros((3, 2, 3))}, "no `bystander_counts`"),
    "bystanders in percent": (CROWD | {"bystanders": np.full((3, 2, 3), 80.0)}, "bystanders: a confidence of 80"),
    "bystanders of one point": (CROWD | {"bystanders": np.zeros((3, 1, 3))}, r"bystanders: float64 of shape \(3, 1, 3\)"),
    "counts of four": (CROWD | {"bystander_counts": np.array([2, 2])}, "bystander_counts: int64 .*2 whole numbers that add up to 3, the detections"),
    "negative counts": (CROWD | {"bystander_counts": np.array([-1, 4])}, "bystander_counts: int64"),
    "counts that wrap around": (CROWD_OF_NINE | {"bystander_counts": np.array([2**62] * 4 + [0] * 4 + [3])}, "bystander_counts: int64"),
    "counts of parts": (CROWD | {"bystander_counts": np.array([1.5, 1.5])}, "bystander_counts: float64"),
    "half a frame": (GOOD | {"first": np.array(0.5)}, "first: float64 of shape"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_refused(tmp_path, fault):
    arrays, sentence = FAULTS[fault]
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(InputError, match=sentence) as error:
        read_series(tmp_path / "a.npz")
    assert str(error.value).startswith(str(tmp_path / "a.npz")) and len(str(error.value).splitlines()) == 1


def test_by_hand_it_starts_at_zero(tmp_path):
    np.savez(tmp_path / "a.npz", **GOOD)
    assert read_series(tmp_path / "a.npz").first == 0
    np.savez(tmp_path / "crowd.npz", **CROWD)
    crowd = read_series(tmp_path / "crowd.npz")
    assert [len(crowd.bystanders_in(frame)) for frame in (0, 1, 2)] == [1, 2, 0] and len(crowd.candidates_in(0)) == 2
    with pytest.raises(InputError, match=r"b.npz: no such file; expected an .npz with `keypoints`.*check the path"):
        read_series(tmp_path / "b.npz")


@pytest.mark.parametrize("seed", range(200))
def test_damaged_files_are_a_sentence(tmp_path, seed):
    # Every second one has other people too.
    crowd = {
        "candidates": Candidates(np.full((5, 2, 4, 3), 0.5), np.full((5, 2), 0.4)),
        "bystanders": Bystanders(np.full((5, 4, 3), 0.5), np.ones(5, int)),
    }
    write_series(tmp_path / "a.npz", series()._replace(**crowd if seed % 2 else {}))
    rng, data = random.Random(seed), bytearray((tmp_path / "a.npz").read_bytes())
    for _ in range(rng.choice((1, 2, 8))):
        data[rng.randrange(len(data))] = rng.randrange(256)
    (tmp_path / "a.npz").write_bytes(data[: rng.choice((len(data), rng.randrange(len(data))))])
    told = ""
    try:
        assert read_series(tmp_path / "a.npz").keypoints.ndim == 3
    except InputError as error:
        told = str(error)
    assert not told or "expected" in told


def test_no_archive_unpacks_without_end(tmp_path, monkeypatch):
    monkeypatch.setattr(arrays_file, "LARGEST_BYTES", 1000)
    np.savez_compressed(tmp_path / "a.npz", keypoints=np.zeros((100, 2, 3)), names=GOOD["names"])
    with pytest.raises(InputError, match=r"\d\d\d\d bytes when unpacked; expected at most 1000"):
        read_series(tmp_path / "a.npz")


# -- following ------------------------------------------------------------------------------------------------------------------------------


def cameras(count: int) -> list[CameraSpec]:
    """Around the origin, four metres away, 1.2 m up, looking at it."""
    specs = []
    for azimuth in np.linspace(0.2, 2.6, count):
        ahead = np.array([-np.cos(azimuth), -np.sin(azimuth), 0.0])
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        R = np.stack([right, np.cross(ahead, right), ahead])
        specs.append(CameraSpec(f"c{azimuth:.1f}", (640, 480), (500.0, 500.0), (320.0, 240.0), 0.0, (0.0,) * 5, R, -R @ (-4 * ahead + [0, 0, 1.2])))
    return specs


def figure(seed: int, height=1.0) -> np.ndarray:
    return height * np.random.default_rng(seed).uniform([-0.25, -0.25, 0.1], [0.25, 0.25, 1.7], (17, 3))


def seen(camera: CameraSpec, points: np.ndarray, rng) -> np.ndarray:
    pixels = cv2.projectPoints(
        points, cv2.Rodrigues(camera.rotation)[0], camera.translation_m, np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]), None
    )
    return np.column_stack([pixels[0][:, 0] + rng.normal(0, 2, (len(points), 2)), np.full(len(points), 0.8)])


def crossing(rig, frames=24, size=0.9):
    """The subject walks by a smaller person who goes the other way; in which order a frame lists them is random. People, and the subject's places."""
    rng, subject, other, people, places = np.random.default_rng(1), figure(0), figure(1, size), [], []
    for k in range(frames):
        x = -1 + 2 * k / (frames - 1)
        both = [subject + np.array([x, 0.0, 0.0]), other + np.array([-x, 0.9, 0.0])]
        listed = [rng.permutation(2) for _ in rig]
        people.append([np.stack([seen(camera, both[i], rng) for i in order]) for camera, order in zip(rig, listed, strict=True)])
        places.append(tuple(int(np.flatnonzero(order == 0)[0]) for order in listed))
    return people, places


@pytest.mark.parametrize("count", [1, 2, 4])
def test_the_subject_of_the_first_frame_is_followed_past_another_person(count):
    rig = cameras(count)
    people, places = crossing(rig)
    # Of two people in view of all cameras nothing tells the subject: in the first frame there is one.
    people[0] = [among[[place]] for among, place in zip(people[0], places[0], strict=True)]
    places[0] = (0,) * count
    assert follow_person(rig, people) == places


def test_a_camera_that_sees_someone_else_is_left_out():
    rig = cameras(3)
    people, places = crossing(rig)
    people[0] = [among[[place]] for among, place in zip(people[0], places[0], strict=True)]
    # For eight frames the second camera lists the other person alone.
    for k in range(8, 16):
        people[k][1] = people[k][1][[1 - places[k][1]]]
        places[k] = (places[k][0], None, places[k][2])
    places[0] = (0, 0, 0)
    assert follow_person(rig, people) == places


def test_one_camera_of_two_goes_on_alone():
    rig, nobody = cameras(2), np.zeros((0, 17, 3))
    people, places = crossing(rig)
    people[0] = [among[[place]] for among, place in zip(people[0], places[0], strict=True)]
    people[9][1] = people[10][1] = nobody
    found = follow_person(rig, people)
    assert found[9:11] == [(places[9][0], None), (places[10][0], None)]
    assert found[11:] == places[11:]


def test_nobody_for_a_while():
    rig, nobody = cameras(2), np.zeros((0, 17, 3))
    people, places = crossing(rig)
    alone = [[among[[place]] for among, place in zip(frame, chosen, strict=True)] for frame, chosen in zip(people, places, strict=True)]
    alone[:3] = [[nobody, nobody]] * 3
    alone[12:18] = [[nobody, nobody]] * 6
    found = follow_person(rig, alone)
    assert found[:3] == [(None, None)] * 3 and found[12:18] == [(None, None)] * 6
    assert found[3:12] == [(0, 0)] * 9 and found[18:] == [(0, 0)] * 6


def test_many_frames_at_once_are_followed_as_single_ones(monkeypatch):
    rig, rng, nobody = cameras(4), np.random.default_rng(3), np.zeros((0, 17, 3))
    people, places = crossing(rig, frames=60, size=1.0)
    for k, (frame, chosen) in enumerate(zip(people, places, strict=True)):
        if not 20 <= k < 25:
            people[k] = [among[[place]] for among, place in zip(frame, chosen, strict=True)]
        for among in people[k]:
            # Some keypoints are elsewhere, and one in ten is not found.
            among[rng.random(among.shape[:2]) < 0.02, :2] += 200
            among[rng.random(among.shape[:2]) < 0.1] = np.nan
    people[10][2] = people[41][0] = nobody
    people[50][1] = people[50][1] + np.array([150.0, 0, 0])
    decided = [body is not None for body in keypoint_series.lone_bodies(rig, people)]
    # Not the first, nor those with two people or with a person elsewhere, nor the frames after these.
    assert [k for k, lone in enumerate(decided) if not lone] == [0, *range(20, 26), 50, 51]
    at_once = follow_person(rig, people)
    assert at_once[10][2] is None and at_once[50][1] is None and at_once[20:25] == places[20:25]
    one_by_one = keypoint_series.PersonFollower(rig)
    assert [one_by_one.follow([frame])[0] for frame in people] == at_once
    monkeypatch.setattr(keypoint_series, "lone_bodies", lambda cameras, frames: [None] * len(frames))
    assert follow_person(rig, people) == at_once


@pytest.mark.slow
def test_the_real_subject_is_followed(pose2sim_beam):
    """Another person stands in two of the views, and is listed first in some frames."""
    from bayes_body.recording.readers.calibration.qualisys import read_qualisys
    from bayes_body.recording.readers.keypoints.openpose import read_openpose
    from bayes_body.recording.readers.keypoints.person import choose_person

    rig = [camera.spec((1088, 1920)) for camera in read_qualisys(pose2sim_beam / "calibration" / "Calib.qca.txt")]
    beam = [read_openpose(pose2sim_beam / "pose" / f"cam0{c}_json", range(0, 100, 4)) for c in (1, 2, 3, 4)]
    people = [[each[k][np.isfinite(each[k, :, :, 0]).any(axis=1)] for each in beam] for k in range(25)]
    found = follow_person(rig, people)
    assert sum(place is None for places in found for place in places) == 0
    # Frame by frame, and without what came before, the same man is chosen.
    assert found[::6] == [choose_person(rig, frame).places for frame in people[::6]]
    assert len(LAYOUTS["BODY_25B"]) == people[0][0].shape[1]
