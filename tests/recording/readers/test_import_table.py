"""The table at the end of an import: every source of every camera, and whatever was not read."""

import json
import unicodedata

import cv2
import numpy as np
import pytest
from body_figures import figures

from bayes_body.base.errors import InputError
from bayes_body.recording.readers.import_table import WIDTH, describe_import
from bayes_body.recording.readers.opencv import import_opencv
from bayes_body.recording.readers.options import Options
from bayes_body.recording.readers.pose2sim import POSES, import_pose2sim

SIZE, FRAMES = (96, 64), 6
K = [[60.0, 0.0, 48.0], [0.0, 60.0, 32.0], [0.0, 0.0, 1.0]]


def pose(i):
    return cv2.Rodrigues(np.array([0.0, 0.9 * i, 0.0]))[0] @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), np.array([0.0, 0.9, 4.0])


def images(folder, frames=FRAMES):
    folder.mkdir(parents=True)
    for k in range(frames):
        cv2.imwrite(str(folder / f"{k:04d}.png"), np.full((SIZE[1], SIZE[0]), 30 * k, np.uint8))


def calibrate(path, names):
    tables = []
    for i, name in enumerate(names):
        R, t = pose(i)
        rotation = cv2.Rodrigues(R)[0].ravel().tolist()
        numbers = f"matrix = {K}\ndistortions = [0.0, 0.0, 0.0, 0.0]\nrotation = {rotation}\ntranslation = {t.tolist()}"
        tables.append(f'[camera_{i}]\nname = "{name}"\nsize = [96.0, 64.0]\n{numbers}\n')
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(tables), encoding="utf-8")


def detect(folder, i, frames=FRAMES):
    folder.mkdir(parents=True)
    R, t = pose(i)
    for k in range(frames):
        x, y, z = figures("COCO_17", 30)[k].T
        pixels = cv2.projectPoints(np.stack([x, -z, y], axis=-1), cv2.Rodrigues(R)[0], t, np.array(K), None)[0][:, 0]
        rows = np.column_stack([pixels, np.full(17, 0.8)])
        (folder / f"{k:04d}.json").write_text(json.dumps({"people": [{"pose_keypoints_2d": rows.ravel().tolist()}]}))


@pytest.fixture
def project(tmp_path):
    """A project of Pose2Sim with two cameras, and with things that belong to none."""
    folder = tmp_path / "project"
    names = ("cam01", "cam02")
    calibrate(folder / "calibration" / "Calib.toml", names)
    for i, name in enumerate(names):
        images(folder / "images" / name, FRAMES + 3 * i)
        detect(folder / "pose" / f"{name}_json", i)
    return folder


def table(project, tmp_path, **given):
    options = Options(up="z", fps=30.0, **given)
    session, remarks = import_pose2sim(project, tmp_path / "s", options)
    lines = describe_import(session, project, options, project / POSES)
    assert all(len(line) <= WIDTH for line in lines)
    return lines, remarks


def test_every_source_is_named(project, tmp_path):
    (project / "Config.toml").write_text("[project]\nmulti_person = false\n")
    lines, _ = table(project, tmp_path)
    assert lines == [
        "calibration calibration/Calib.toml: 2 cameras, at most 3.48 m apart",
        "keypoints   order COCO_17",
        "camera  recording     frames         per s  keypoints        person  masks",
        "cam01   images/cam01  6 of 6 from 0  30     pose/cam01_json  6 of 6  -",
        "cam02   images/cam02  6 of 9 from 0  30     pose/cam02_json  6 of 6  -",
    ]


def test_what_is_not_used_is_named_with_the_reason(project, tmp_path):
    calibrate(project / "Calib_old.toml", ("cam01", "cam02"))
    images(project / "images" / "cam03")
    images(project / "cam01")
    (project / "pose" / "cam02_json").rename(project / "pose" / "cam2_json")
    (project / "masks").mkdir()
    lines, remarks = table(project, tmp_path)
    assert lines[-7:] == [
        "Not used:",
        "  Calib_old.toml  another calibration",
        "  images/cam03    no camera is called cam03",
        "  cam01           another recording of this camera is used",
        "  masks           masks are read with --masks",
        "  pose/cam2_json  no camera is called cam2; if it is that of cam02, rename it cam02_json",
        "  camera cam02    nothing in pose has its name: no keypoints",
    ]
    assert not any("not used" in remark.lower() for remark in remarks)


def test_keypoints_of_no_camera_at_all_are_a_note_too(project, tmp_path):
    for name in ("cam01", "cam02"):
        (project / "pose" / f"{name}_json").rename(project / "pose" / f"{name}_2D")
    lines, remarks = table(project, tmp_path)
    assert f"No keypoints are imported: nothing in {project / 'pose'} has a camera's name." in remarks
    assert "  pose/cam02_2D  no camera is called cam02_2D; if it is that of cam02, rename it cam02_json" in lines


def test_keypoints_in_a_folder_that_nobody_named(project, tmp_path):
    options = Options("m", "z", fps=30.0)
    session, _ = import_opencv(project, tmp_path / "s", options)
    lines = describe_import(session, project, options)
    assert lines[-2:] == ["Not used:", "  pose  keypoints are read with --keypoints"]


def test_long_names_and_many_files_stay_in_the_lines(project, tmp_path):
    for k in range(30):
        images(project / "images" / f"a_camera_of_a_laboratory_with_a_very_long_name_{k}", 1)
    lines, _ = table(project, tmp_path)
    assert lines[-1] == "  and 18 more"


def test_recordings_in_a_deeper_folder_are_named_with_the_option(project, tmp_path):
    (project / "videos" / "trial_1").mkdir(parents=True)
    for name in ("cam01", "cam02"):
        (project / "images" / name).rename(project / "videos" / "trial_1" / name)
    with pytest.raises(InputError, match=rf"no recording of a camera; there are some in .*trial_1; .* give --videos {project}/videos/trial_1\.$"):
        table(project, tmp_path)
    lines, _ = table(project, tmp_path, videos=project / "videos" / "trial_1")
    assert "cam01   videos/trial_1/cam01  6 of 6 from 0  30     pose/cam01_json  6 of 6  -" in lines


def test_names_are_compared_in_one_form(project, tmp_path):
    name = "caméra"
    calibrate(project / "calibration" / "Calib.toml", (name, "cam02"))
    decomposed = unicodedata.normalize("NFD", name)
    (project / "images" / "cam01").rename(project / "images" / decomposed)
    (project / "pose" / "cam01_json").rename(project / "pose" / f"{decomposed}_json")
    images(project / "silent" / decomposed)
    images(project / "silent" / "cam02", FRAMES + 3)
    session, _ = import_pose2sim(project, tmp_path / "s", Options(up="z", fps=30.0, masks=project / "silent", offsets={name: 0}))
    assert [view.camera.name for view in session.views] == [name, "cam02"]
    assert all(view.keypoints is not None and view.masks is not None for view in session.views)
