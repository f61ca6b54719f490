"""Keypoints that come in with a recording: whose they are, where they are written, and what is said of them."""

import json
import re
from dataclasses import replace

import cv2
import h5py
import numpy as np
import pytest
from body_figures import figures

from bayes_body.base.errors import InputError
from bayes_body.recording.observation.frames import read_frame
from bayes_body.recording.readers.keypoints.openpose import LAYOUTS
from bayes_body.recording.readers.keypoints.series import read_series
from bayes_body.recording.readers.opencv import import_opencv
from bayes_body.recording.readers.options import Options
from bayes_body.recording.session.read import load_session, save_session

FRAMES, SIZE = 6, (96, 64)
K = np.array([[60.0, 0, 48], [0, 60, 32], [0, 0, 1]])


def pose(i: int):
    turn = cv2.Rodrigues(np.array([0.0, 0.9 * i, 0.0]))[0] @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    return turn, np.array([0.0, 0.9, 4.0])


def calibrate(path, R, t):
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in zip(("K", "dist", "R", "T"), (K, np.zeros(5), R, t), strict=True):
        file.write(key, value)
    file.release()


def make_lab(folder, written=lambda R, t: (R, t)):
    """Two cameras with OpenCV's calibration in metres, six images of each, the second's counted from 2; `written` is what the file has of R and t."""
    for i, name in enumerate(("left", "right")):
        (folder / name).mkdir(parents=True)
        calibrate(folder / f"{name}.yml", *written(*pose(i)))
        for k in range(FRAMES):
            image = np.random.default_rng(k).integers(0, 255, (SIZE[1], SIZE[0], 3), np.uint8)
            cv2.imwrite(str(folder / name / f"{k + 2 * i:04d}.png"), image)
    return folder


@pytest.fixture
def lab(tmp_path):
    return make_lab(tmp_path / "lab")


def person(frame: int) -> np.ndarray:
    x, y, z = figures("COCO_17", 30)[frame].T
    return np.stack([x, -z, y], axis=-1)


def detect(folder, missing=()):
    """Files of COCO_17, numbered as the images; one keypoint is outside of the image."""
    for i, name in enumerate(("left", "right")):
        (folder / f"{name}_json").mkdir(parents=True)
        for k in range(FRAMES):
            R, t = pose(i)
            pixels = cv2.projectPoints(person(k), cv2.Rodrigues(R)[0], t, K, None)[0][:, 0]
            rows = np.column_stack([pixels, np.full(17, 0.8)])
            rows[15] = -5.0, 3.0, 0.8
            found = [] if (i, k) in missing else [{"pose_keypoints_2d": rows.ravel().tolist()}]
            (folder / f"{name}_json" / f"{name}.{k + 2 * i:04d}.json").write_text(json.dumps({"people": found}))
    return folder


def options(**given) -> Options:
    return Options("m", "z", fps=30.0, **given)


def test_every_frame_has_its_own(lab, tmp_path):
    session, _ = import_opencv(lab, tmp_path / "s", options(keypoints=detect(tmp_path / "pose", missing={(1, 4)})))
    assert [view.keypoints for view in session.views] == ["keypoints/left.npz", "keypoints/right.npz"]
    assert load_session(save_session(session)) == session
    for k in range(FRAMES):
        for i, found in enumerate(read_frame(session, k).keypoints or ()):
            if (i, k) == (1, 4):
                assert found == {}
                continue
            R, t = pose(i)
            pixels = cv2.projectPoints(person(k), cv2.Rodrigues(R)[0], t, K, None)[0][:, 0]
            np.testing.assert_allclose(found["l_knee"], [*pixels[13], 0.8], rtol=1e-5)
            assert "l_ankle" not in found and "r_ankle" in found
    # The first pose is the first frame's.
    assert session.initial_keypoints["left"]["l_knee"] == pytest.approx(read_frame(session, 0).keypoints[0]["l_knee"], rel=1e-5)


def test_a_session_that_starts_later_reads_the_same_frames(lab, tmp_path):
    session, _ = import_opencv(lab, tmp_path / "s", options(keypoints=detect(tmp_path / "pose")))
    later = replace(session, first_frame=session.first_frame + 2, frames=3)
    assert read_frame(later, 1).keypoints == read_frame(session, 3).keypoints


def test_a_range_of_frames_has_its_own_keypoints(lab, tmp_path):
    found = detect(tmp_path / "pose")
    whole, _ = import_opencv(lab, tmp_path / "whole", options(keypoints=found))
    session, _ = import_opencv(lab, tmp_path / "s", options(keypoints=found, first_frame=2, frames=3))
    assert (session.first_frame, session.frames, session.recorded) == (2, 3, (0, FRAMES))
    series = read_series(session.keypoints_path(session.views[1]))
    # The second camera's files are counted from 2.
    assert (series.first, len(series.keypoints)) == (4, 3)
    assert [read_frame(session, k).keypoints for k in range(3)] == [read_frame(whole, 2 + k).keypoints for k in range(3)]
    # The first pose is that of the first frame of the range.
    assert session.initial_keypoints["left"]["l_knee"] == pytest.approx(read_frame(whole, 2).keypoints[0]["l_knee"], rel=1e-5)


def test_nobody_in_the_first_frame_is_said_with_the_first_that_shows_somebody(lab, tmp_path):
    missing = {(i, k) for i in range(2) for k in (0, 1)} | {(1, 2)}
    session, remarks = import_opencv(lab, tmp_path / "s", options(keypoints=detect(tmp_path / "pose", missing)))
    assert not session.initial_keypoints
    # In frame 2 one of two cameras sees the subject, which is too few for a first pose.
    said = "in frame 0, the first one: the session has no first keypoints; they show the subject from frame 3 on: begin there with --first-frame 3."
    assert any(remark.endswith(said) for remark in remarks)
    later, remarks = import_opencv(lab, tmp_path / "later", options(keypoints=tmp_path / "pose", first_frame=3))
    assert set(later.initial_keypoints) == {"left", "right"} and not any("no first keypoints" in remark for remark in remarks)


@pytest.mark.parametrize("missing", [(3, 4), (0, 1)])
def test_frames_without_a_file(lab, tmp_path, missing):
    detect(tmp_path / "pose")
    for k in missing:
        (tmp_path / "pose" / "left_json" / f"left.{k:04d}.json").unlink()
    session, remarks = import_opencv(lab, tmp_path / "s", options(keypoints=tmp_path / "pose"))
    assert "Frames that the keypoint files do not have: left 2 of 6: the keypoints are missing there." in remarks
    assert [bool(read_frame(session, k).keypoints[0]) for k in range(FRAMES)] == [k not in missing for k in range(FRAMES)]


def by_camera(folder):
    """The keypoints of OpenPose's files: {camera: {number: (keypoint, 3)}}."""
    cameras = {}
    for path in sorted(folder.glob("*_json/*.json")):
        points = np.reshape(json.loads(path.read_text())["people"][0]["pose_keypoints_2d"], (-1, 3))
        cameras.setdefault(path.parent.name.removesuffix("_json"), {})[int(path.stem.split(".")[1])] = points
    return cameras


def as_alphapose(folder, name, frames):
    people = [{"image_id": f"{number}.jpg", "keypoints": points.ravel().tolist(), "score": 2.5} for number, points in frames.items()]
    (folder / f"{name}.json").write_text(json.dumps(people))


def as_mmpose(folder, name, frames):
    (folder / name).mkdir()
    listed = [
        {"frame_id": number, "instances": [{"keypoints": points[:, :2].tolist(), "keypoint_scores": points[:, 2].tolist()}]}
        for number, points in frames.items()
    ]
    (folder / name / "results_000000.json").write_text(json.dumps({"meta_info": {"dataset_name": "coco"}, "instance_info": listed}))


def as_deeplabcut(folder, name, frames):
    parts = [part.replace("l_", "left_").replace("r_", "right_") for part in LAYOUTS["COCO_17"]]
    heads = [["scorer", *["net"] * 51], ["bodyparts", *np.repeat(parts, 3)], ["coords", *["x", "y", "likelihood"] * 17]]
    rows = [[str(number), *map(repr, points.ravel().tolist())] for number, points in frames.items()]
    (folder / f"{name}DLC_resnet50.csv").write_text("\n".join(",".join(row) for row in [*heads, *rows]))


def as_sleap(folder, name, frames):
    head = ["track", "frame_idx", "instance.score", *(f"{part}.{kind}" for part in LAYOUTS["COCO_17"] for kind in ("x", "y", "score"))]
    rows = [["", str(number), "0.9", *map(repr, points.ravel().tolist())] for number, points in frames.items()]
    (folder / f"{name}.analysis.csv").write_text("\n".join(",".join(row) for row in [head, *rows]))


def as_sleap_h5(folder, name, frames):
    last = max(frames)
    places = np.full((1, 2, 17, last + 1), np.nan)
    scores = np.full((1, 17, last + 1), np.nan)
    for number, points in frames.items():
        places[0, :, :, number], scores[0, :, number] = points[:, :2].T, points[:, 2]
    with h5py.File(folder / f"{name}.h5", "w") as file:
        file["tracks"], file["point_scores"], file["node_names"] = places, scores, np.array(LAYOUTS["COCO_17"], "S")


PROGRAMS = {"AlphaPose": as_alphapose, "MMPose": as_mmpose, "DeepLabCut": as_deeplabcut, "SLEAP": as_sleap, "SLEAP, h5": as_sleap_h5}


@pytest.mark.parametrize("program", PROGRAMS)
def test_a_file_of_a_whole_video_says_the_same(lab, tmp_path, program):
    openpose = detect(tmp_path / "pose")
    wanted, _ = import_opencv(lab, tmp_path / "wanted", options(keypoints=openpose))
    folder = tmp_path / "whole"
    folder.mkdir()
    for name, frames in by_camera(openpose).items():
        PROGRAMS[program](folder, name, frames)
    session, _ = import_opencv(lab, tmp_path / "s", options(keypoints=folder))
    for frame in range(FRAMES):
        for seen, expected in zip(read_frame(session, frame).keypoints, read_frame(wanted, frame).keypoints, strict=True):
            assert seen.keys() == expected.keys()
            np.testing.assert_allclose(list(seen.values()), list(expected.values()), rtol=1e-5)


def test_a_pickled_table_is_refused(lab, tmp_path):
    folder = tmp_path / "whole"
    folder.mkdir()
    with h5py.File(folder / "leftDLC_resnet50.h5", "w") as file:
        file.create_group("df_with_missing")["table"] = np.zeros(3)
    with pytest.raises(InputError, match=r"leftDLC_resnet50.h5: DeepLabCut's table in HDF5, whose header is pickled; expected its csv"):
        import_opencv(lab, tmp_path / "s", options(keypoints=folder))


def test_points_of_faces_and_hands_are_left_out(lab, tmp_path):
    openpose = detect(tmp_path / "pose")
    wanted, _ = import_opencv(lab, tmp_path / "wanted", options(keypoints=openpose))
    for path in openpose.glob("*_json/*.json"):
        content = json.loads(path.read_text())
        content["people"][0]["pose_keypoints_2d"] += [0.0] * 3 * (133 - 17)
        path.write_text(json.dumps(content))
    session, _ = import_opencv(lab, tmp_path / "s", options(keypoints=openpose))
    assert len(read_series(session.keypoints_path(session.views[0])).names) == 23
    assert read_frame(session, 3).keypoints == read_frame(wanted, 3).keypoints


def test_numbers_that_are_not_the_frames_are_refused_unless_the_first_is_given(lab, tmp_path):
    openpose = detect(tmp_path / "pose")
    wanted, _ = import_opencv(lab, tmp_path / "wanted", options(keypoints=openpose))
    for path in sorted(openpose.glob("left_json/*.json"), reverse=True):
        path.rename(path.with_name(f"left.{int(path.stem.split('.')[1]) + 1:04d}.json"))
    with pytest.raises(
        InputError, match=r"left_json: keypoints of 6 frames, numbered 1 to 6; expected numbers 0 to 5, .* give --keypoints-first left=1"
    ):
        import_opencv(lab, tmp_path / "s", options(keypoints=openpose))
    session, _ = import_opencv(lab, tmp_path / "s", options(keypoints=openpose, keypoints_first={"left": 1}))
    assert [read_frame(session, k).keypoints for k in range(FRAMES)] == [read_frame(wanted, k).keypoints for k in range(FRAMES)]


def test_a_camera_without_keypoints(lab, tmp_path):
    pose_folder = detect(tmp_path / "pose")
    (pose_folder / "right_json").rename(pose_folder / "other_json")
    session, _ = import_opencv(lab, tmp_path / "s", options(keypoints=pose_folder))
    assert [view.keypoints for view in session.views] == ["keypoints/left.npz", None]
    assert read_frame(session, 0).keypoints[1] is None


def test_two_cameras_that_do_not_agree_are_refused(lab, tmp_path):
    folder = detect(tmp_path / "pose")
    for path in (folder / "right_json").iterdir():
        person = np.reshape(json.loads(path.read_text())["people"][0]["pose_keypoints_2d"], (-1, 3))
        # Mirrored: no turn does that.
        person[:, 1] = SIZE[1] - person[:, 1]
        path.write_text(json.dumps({"people": [{"pose_keypoints_2d": person.ravel().tolist()}]}))
    with pytest.raises(
        InputError, match=r"lab: the keypoints contradict it: no two of 2 cameras agree .* expected both cameras to agree; .* --rig as_given"
    ):
        import_opencv(lab, tmp_path / "s", options(keypoints=folder))
    assert not (tmp_path / "s").exists()
    _, remarks = import_opencv(lab, tmp_path / "s", options(keypoints=folder, rig={"": "as_given"}))
    assert "--rig as_given: the calibration stays as it is, whatever the keypoints say." in remarks
    pattern = re.compile(r"camera 'right': its keypoints contradict .* in \d of 6 frames: .* calibration or its clock is off")
    assert any(pattern.match(remark) for remark in remarks)


def test_a_rig_is_changed_on_request_only(lab, tmp_path):
    folder = detect(tmp_path / "pose")
    wanted, _ = import_opencv(lab, tmp_path / "wanted", options(keypoints=folder))
    flip = np.diag([1.0, -1.0, -1.0])
    conventions = {
        # Both cameras look at the origin from one distance.
        "inverted": (lambda R, t: (R.T, -R.T @ t), "all cameras within .* import with --rig inverted"),
        "opengl": (lambda R, t: (flip @ R, flip @ t), r"the keypoints contradict it: .* the rays of the keypoints meet if .*\(--rig opengl\)"),
    }
    for change, (written, sentence) in conventions.items():
        source = make_lab(tmp_path / change, written)
        with pytest.raises(InputError, match=sentence):
            import_opencv(source, tmp_path / "s", options(keypoints=folder))
        session, remarks = import_opencv(source, tmp_path / "s", options(keypoints=folder, rig={"": change}))
        assert remarks[0].startswith(f"--rig {change}: the calibration was changed, since ")
        for view, expected in zip(session.views, wanted.views, strict=True):
            np.testing.assert_allclose(view.camera.rotation, expected.camera.rotation, atol=1e-9)
            np.testing.assert_allclose(view.camera.translation_m, expected.camera.translation_m, atol=1e-6)
        (tmp_path / "s" / "session.toml").unlink()
    for rig, sentence in {
        ("left", "turned_18"): "--rig: 'turned_18': no such change of a calibration; did you mean 'turned_180'",
        ("lift", "turned_180"): "--rig: 'lift': no such camera; did you mean 'left'",
        ("left", "scaled"): "--rig left=scaled: its calibration does not state the size of its pictures; expected half_size or double_size",
    }.items():
        with pytest.raises(InputError, match=re.escape(sentence)):
            import_opencv(lab, tmp_path / "s", options(rig=dict([rig])))


def rewrite(folder, change):
    """Change the people of every file: `change(people)` of arrays (keypoint, 3)."""
    for path in folder.glob("*_json/*.json"):
        people = [np.reshape(one["pose_keypoints_2d"], (-1, 3)) for one in json.loads(path.read_text())["people"]]
        path.write_text(json.dumps({"people": [{"pose_keypoints_2d": points.ravel().tolist()} for points in change(people)]}))


def test_shares_of_the_images_sides_are_read_if_said(lab, tmp_path):
    wanted, _ = import_opencv(lab, tmp_path / "wanted", options(keypoints=detect(tmp_path / "pose")))
    with pytest.raises(InputError, match=r"--keypoints-unit share: left, right: coordinates above 2; expected shares"):
        import_opencv(lab, tmp_path / "s", options(keypoints=tmp_path / "pose", keypoints_unit="share"))
    rewrite(tmp_path / "pose", lambda people: [points / [*SIZE, 1] for points in people])
    with pytest.raises(InputError, match=r"keypoints: left, right: no coordinate is above 2; expected pixels; .* --keypoints-unit share"):
        import_opencv(lab, tmp_path / "s", options(keypoints=tmp_path / "pose"))
    with pytest.raises(InputError, match=r"--keypoints-unit: 'shares': no such unit; did you mean 'share'"):
        import_opencv(lab, tmp_path / "s", options(keypoints=tmp_path / "pose", keypoints_unit="shares"))
    assert not (tmp_path / "s").exists()
    session, _ = import_opencv(lab, tmp_path / "s", options(keypoints=tmp_path / "pose", keypoints_unit="share"))
    np.testing.assert_allclose(read_frame(session, 3).keypoints[1]["l_knee"], read_frame(wanted, 3).keypoints[1]["l_knee"], rtol=1e-5)


def test_a_person_who_is_detected_twice_is_one(lab, tmp_path):
    detect(tmp_path / "pose")
    rewrite(tmp_path / "pose", lambda people: [*(points * [1, 1, 0.9] + [0.1, 0, 0] for points in people), *people])
    session, remarks = import_opencv(lab, tmp_path / "s", options(keypoints=tmp_path / "pose"))
    said = [remark for remark in remarks if "several people" in remark or "detected in the same frame already" in remark]
    assert said == ["Detections of a person who was detected in the same frame already are left out: left 6, right 6."]
    assert read_frame(session, 2).keypoints[0]["nose"][2] == pytest.approx(0.8)


def test_a_camera_that_sees_nobody_is_named(lab, tmp_path):
    _, remarks = import_opencv(lab, tmp_path / "s", options(keypoints=detect(tmp_path / "pose", {(1, k) for k in range(FRAMES)})))
    assert "right: its keypoint files show nobody in any of the 6 frames." in remarks
    assert not any("several people" in remark for remark in remarks)


def test_an_order_by_camera_is_read(lab, tmp_path):
    wanted, _ = import_opencv(lab, tmp_path / "wanted", options(keypoints=detect(tmp_path / "pose")))
    for camera, layout in (("left", "BODY_25"), ("right", "BODY_25B")):
        for path in (tmp_path / "pose" / f"{camera}_json").iterdir():
            points = dict(zip(LAYOUTS["COCO_17"], np.reshape(json.loads(path.read_text())["people"][0]["pose_keypoints_2d"], (-1, 3)), strict=True))
            rows = np.stack([points.get(name, np.zeros(3)) for name in LAYOUTS[layout]])
            path.write_text(json.dumps({"people": [{"pose_keypoints_2d": rows.ravel().tolist()}]}))
    session, remarks = import_opencv(lab, tmp_path / "s", options(keypoints=tmp_path / "pose"))
    assert any("(left: BODY_25; right: BODY_25B)" in remark for remark in remarks)
    assert [read_frame(session, k).keypoints for k in range(FRAMES)] == [read_frame(wanted, k).keypoints for k in range(FRAMES)]


def test_a_giant_is_refused_before_anything_is_written(lab, tmp_path):
    for i, name in enumerate(("left", "right")):
        R, t = pose(i)
        calibrate(lab / f"{name}.yml", R, 10 * t)
    with pytest.raises(InputError, match=r"stature: the person is 17[\.\d]* m tall .*; expected 0.75 to 2.3 m; no unit"):
        import_opencv(lab, tmp_path / "s", options(keypoints=detect(tmp_path / "pose")))
    assert not (tmp_path / "s").exists()


def test_what_is_wrong_is_said(lab, tmp_path):
    with pytest.raises(
        InputError, match=r"--keypoints .*nowhere: no folder or file of any camera in it; expected for each camera a folder CAMERA_json"
    ):
        import_opencv(lab, tmp_path / "s", options(keypoints=tmp_path / "nowhere"))
    with pytest.raises(InputError, match="--layout: COCO_17, but there are no keypoints; expected"):
        import_opencv(lab, tmp_path / "s", options(layout="COCO_17"))
    detect(tmp_path / "pose")
    with pytest.raises(InputError, match="--layout BODY_25: 17 keypoints per person; expected 25"):
        import_opencv(lab, tmp_path / "s", options(keypoints=tmp_path / "pose", layout="BODY_25"))
    (tmp_path / "pose" / "left_json" / "left.0002.json").write_text("{")
    with pytest.raises(InputError, match=r"left.0002.json: not JSON"):
        import_opencv(lab, tmp_path / "s", options(keypoints=tmp_path / "pose"))
    assert not (tmp_path / "s").exists()


def test_files_of_a_session_by_hand(lab, tmp_path):
    """As the guide tells it: names of markers, numbers from the camera's first file on."""
    session, _ = import_opencv(lab, tmp_path / "s", options())
    assert read_frame(session, 0).keypoints is None
    np.savez(tmp_path / "s" / "mine.npz", keypoints=np.full((FRAMES + 2, 1, 3), [5.0, 6.0, 1.0]), names=np.array(["pelvis"]))
    hand = replace(session, views=(session.views[0], replace(session.views[1], keypoints="mine.npz")))
    assert read_series(hand.keypoints_path(hand.views[1])).first == 0
    assert read_frame(load_session(save_session(hand)), 5).keypoints == (None, {"pelvis": (5.0, 6.0, 1.0)})
