"""OpenPose's files: read, named, refused; and the real ones against the body they must be of."""

import json

import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.recording.readers.calibration.qualisys import read_qualisys
from bayes_body.recording.readers.keypoints.openpose import (
    LAYOUTS,
    Tally,
    describe_tallies,
    keypoint_files,
    read_openpose,
    read_people,
)
from bayes_body.recording.readers.keypoints.person import choose_person
from bayes_body.recording.readers.keypoints.triangulate import triangulate


def person(keypoints: int, seed: int = 0) -> list[float]:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(0, 600, (keypoints, 2)), rng.uniform(0.1, 1.0, keypoints)]).ravel().tolist()


def write(path, *people: list[float]):
    path.write_text(json.dumps({"version": 1.3, "people": [{"pose_keypoints_2d": each, "face_keypoints_2d": []} for each in people]}))
    return path


def test_people_of_a_frame(tmp_path):
    one, two = person(25), person(25, 1)
    one[3:6] = [0, 0, 0]
    two[2] = 1.02
    found = read_people(write(tmp_path / "a.0000.json", one, two))
    assert found.shape == (2, 25, 3)
    np.testing.assert_array_equal(found[0, 2], one[6:9])
    np.testing.assert_array_equal(found[0, 1], [np.nan, np.nan, 0])
    assert found[1, 0, 2] == 1
    assert read_people(write(tmp_path / "b.json")).shape == (0, 0, 3)


@pytest.mark.parametrize("unknown", ["NaN", "null"])
def test_a_keypoint_without_a_place_is_not_seen_whatever_its_confidence(tmp_path, unknown):
    text = f'{{"people": [{{"pose_keypoints_2d": [{unknown}, {unknown}, 0.9, 7, 8, 95]}}]}}'
    (tmp_path / "a.0000.JSON").write_text(text)
    tally = Tally()
    seen = read_people(tmp_path / "a.0000.JSON", tally)
    np.testing.assert_array_equal(seen, [[[np.nan, np.nan, 0], [7, 8, 1]]])
    assert list(keypoint_files(tmp_path)) == [0]
    placed, cut = describe_tallies({"a": tally, "b": Tally()})
    assert placed == "Keypoints with a confidence and no place (NaN or null) count as not found: a 1."
    assert cut == "Confidences up to 95 are cut to 1 (a); they look like per cent: divide them by 100."


def test_a_series_is_ragged(tmp_path):
    write(tmp_path / "walk_000000000007_keypoints.json", person(18), person(18, 1))
    write(tmp_path / "walk_000000000008_keypoints.json")
    write(tmp_path / "walk_000000000010_keypoints.json", person(18, 2))
    series = read_openpose(tmp_path, [7, 8, 10])
    assert series.shape == (3, 2, 18, 3)
    np.testing.assert_array_equal(np.isfinite(series[..., 0]).any(axis=-1), [[True, True], [False, False], [True, False]])
    np.testing.assert_array_equal(series[1, :, :, 2], 0)
    np.testing.assert_array_equal(series[2, 0], np.reshape(person(18, 2), (18, 3)))
    with pytest.raises(InputError, match="1 of 3 frames have no file, the first is 9; expected a file for each frame; there are 7 to 10"):
        read_openpose(tmp_path, [8, 9, 10])


FAULTS = {
    "no JSON": ("{", "not JSON"),
    "a list": ("[]", "no list `people`"),
    "two and a half numbers": ('{"people": [{"pose_keypoints_2d": [1, 2, 0.5, 4]}]}', "pose_keypoints_2d: 4 numbers; expected x, y, confidence"),
    "nothing": ('{"people": [{}]}', "person 1: pose_keypoints_2d: none"),
    "text": ('{"people": [{"pose_keypoints_2d": [1, "2", 0.5]}]}', "an entry that is not a number"),
    "true": ('{"people": [{"pose_keypoints_2d": [1, true, 0.5]}]}', "an entry that is not a number"),
    "far away": ('{"people": [{"pose_keypoints_2d": [1e9, 2, 0.5]}]}', "far outside any image"),
    "a thousand digits": ('{"people": [{"pose_keypoints_2d": [' + "9" * 5000 + ", 2, 0.5]}]}", "not JSON with valid numbers"),
    "nested without end": ("[" * 100000, "not JSON"),
    "unequal people": (
        '{"people": [{"pose_keypoints_2d": [1, 2, 1]}, {"pose_keypoints_2d": [1, 2, 1, 3, 4, 1]}]}',
        "people with 1 and with 2 keypoints",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_refused(tmp_path, fault):
    text, sentence = FAULTS[fault]
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(InputError, match=f"^{tmp_path}/a.json.*{sentence}") as error:
        read_people(tmp_path / "a.json")
    assert len(str(error.value).splitlines()) == 1


def test_folders(tmp_path):
    with pytest.raises(InputError, match="no numbered json files in it"):
        keypoint_files(tmp_path / "none")
    write(tmp_path / "a.0001.json", person(17))
    write(tmp_path / "b.0001.json", person(17))
    with pytest.raises(InputError, match="2 files with 1 different numbers"):
        keypoint_files(tmp_path)
    write(tmp_path / "b.0001.json", person(18)).rename(tmp_path / "b.0002.json")
    with pytest.raises(InputError, match="frames with 17 and with 18 keypoints"):
        read_openpose(tmp_path, [1, 2])


def test_layouts_name_every_keypoint_once():
    for name, keypoints in LAYOUTS.items():
        assert len(set(keypoints)) == len(keypoints) == int(name.split("_")[1].removesuffix("B"))
        sides = {keypoint.removeprefix("l_") for keypoint in keypoints if keypoint.startswith("l_")}
        assert sides == {keypoint.removeprefix("r_") for keypoint in keypoints if keypoint.startswith("r_")}


@pytest.fixture(scope="module")
def beam(pose2sim_beam):
    """All detections of the real recording, by camera."""
    return [read_openpose(pose2sim_beam / "pose" / f"cam0{c}_json", range(100)) for c in (1, 2, 3, 4)]


def test_the_real_body_has_its_measures(beam, pose2sim_beam):
    rig = [camera.spec((1088, 1920)) for camera in read_qualisys(pose2sim_beam / "calibration" / "Calib.qca.txt")]
    index = {name: k for k, name in enumerate(LAYOUTS["BODY_25B"])}
    found, errors = [], []
    for frame in range(0, 100, 10):
        people = [each[frame][np.isfinite(each[frame, :, :, 0]).any(axis=1)] for each in beam]
        chosen = choose_person(rig, people)
        # The bystander is in two of the views.
        assert chosen is not None and None not in chosen.places
        body = triangulate(rig, np.stack([among[place] for among, place in zip(people, chosen.places, strict=True)]))
        found.append(body.points_m)
        errors.append(body.error_px)
    points = np.array(found)

    def length(a, b):
        return np.nanmedian([np.linalg.norm(points[:, index[f"{side}_{a}"]] - points[:, index[f"{side}_{b}"]], axis=-1) for side in "lr"])

    # The set's README: some 13 px; and 0.38, 0.37, 0.86 m, of which 5 cm are the set's own error.
    assert 8 < np.nanmedian(errors) < 18
    assert length("hip", "knee") == pytest.approx(0.38, abs=0.05)
    assert length("knee", "ankle") == pytest.approx(0.37, abs=0.05)
    assert np.nanmedian(points[:, [index["l_hip"], index["r_hip"]], 2]) == pytest.approx(0.86, abs=0.05)
