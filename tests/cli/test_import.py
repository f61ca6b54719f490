"""`bayes-body import`: a session, a picture to check it by, and sentences about what is wrong with a recording."""

import cv2
import numpy as np
import pytest
import xarray as xr


def test_import_leaves_a_session_and_a_picture(cli, bodytrack, tmp_path):
    outcome = cli("import", "parsec", bodytrack, tmp_path / "walk")
    assert outcome.status == 0
    assert (tmp_path / "walk" / "session.toml").is_file()
    assert cv2.imread(str(tmp_path / "walk" / "check.png")) is not None
    assert "check.png" in outcome.out
    assert "4 cameras, 4 frames" in outcome.out


def test_a_folder_that_does_not_exist(cli, tmp_path):
    cli("import", "parsec", tmp_path / "nowhere", tmp_path / "walk").refuses(str(tmp_path / "nowhere"), "no such folder", "check the path")


def test_a_folder_that_is_no_recording(cli, tmp_path):
    (tmp_path / "empty").mkdir()
    sentences = cli("import", "parsec", tmp_path / "empty", tmp_path / "walk").refusals
    assert "CALIB" in sentences[0]
    assert all(str(tmp_path / "empty") in sentence and "expected" in sentence for sentence in sentences)
    assert not (tmp_path / "walk").exists()


def test_a_session_folder_that_is_a_file(cli, bodytrack, tmp_path):
    (tmp_path / "walk").write_text("")
    cli("import", "parsec", bodytrack, tmp_path / "walk").refuses(str(tmp_path / "walk"), "cannot be written", "expected")


CALIBRATIONS = {
    "24 numbers": (lambda numbers: numbers[:24], ["24 numbers", "expected 25", "restore"]),
    "no focal length": (lambda numbers: ["0", *numbers[1:]], ["focal length x = 0", "expected a positive number"]),
    "no rotation": (lambda numbers: [*numbers[:10], "0.5", *numbers[11:]], ["numbers 11 to 19", "not a rotation", "expected"]),
    "a word": (lambda numbers: ["wide", *numbers[1:]], ["line 1", "'wide'", "expected a finite number"]),
    "NaN": (lambda numbers: ["nan", *numbers[1:]], ["line 1", "'nan'", "expected a finite number"]),
}


@pytest.mark.parametrize("fault", CALIBRATIONS)
def test_a_calibration_that_cannot_be_used(cli, copy, tmp_path, fault):
    change, parts = CALIBRATIONS[fault]
    path = copy.edit("CALIB/Camera1.cal", change)
    cli("import", "parsec", copy.folder, tmp_path / "walk").refuses(str(path), *parts)
    assert not (tmp_path / "walk").exists()


def _missing(path):
    path.unlink()


def _truncated(path):
    path.write_bytes(path.read_bytes()[:1000])


def _empty(path):
    path.write_bytes(b"")


def _small(path):
    cv2.imwrite(str(path), np.zeros((10, 20), np.uint8))


IMAGES = {
    "missing image": ("CAM2/image0002.bmp", _missing, ["CAM2", "image0002.bmp", "missing", "restore"]),
    "missing first image": ("CAM2/image0000.bmp", _missing, ["CAM2", "image0000.bmp", "missing", "restore"]),
    "missing mask": ("FG3/image0003.bmp", _missing, ["FG3", "image0003.bmp", "missing", "restore"]),
    "truncated image": ("CAM2/image0000.bmp", _truncated, ["CAM2/image0000.bmp", "cut short", "expected a whole image", "copy the file again"]),
    "empty image": ("CAM2/image0000.bmp", _empty, ["CAM2/image0000.bmp", "empty", "expected an image", "copy the file again"]),
    "truncated mask": ("FG2/image0000.bmp", _truncated, ["FG2/image0000.bmp", "cut short", "expected a whole image"]),
    "masks of another size": ("FG2/image0000.bmp", _small, ["FG2/image0000.bmp", "20 x 10", "expected 640 x 480"]),
}


@pytest.mark.parametrize("fault", IMAGES)
def test_images_that_cannot_be_used(cli, copy, tmp_path, fault):
    name, damage, parts = IMAGES[fault]
    damage(copy.image(name))
    cli("import", "parsec", copy.folder, tmp_path / "walk").refuses(*parts)


LATER = {
    "another size": ("CAM1/image0003.bmp", _small, ["CAM1/image0003.bmp", "20 x 10", "expected 640 x 480", "scale focal_px"]),
    "masks of another size": ("FG4/image0001.bmp", _small, ["FG4/image0001.bmp", "20 x 10", "expected 640 x 480"]),
}
LOST = {
    "missing": ("CAM2/image0002.bmp", _missing),
    "truncated": ("CAM2/image0003.bmp", _truncated),
    "truncated between": ("CAM2/image0002.bmp", _truncated),
}


@pytest.fixture
def damaged(cli, copy, tmp_path):
    """`damaged(name, damage)`: what tracking says when an image was damaged after the import."""
    from bayes_body.recording.readers.parsec import import_parsec

    def call(name, damage):
        path = copy.image(name)
        import_parsec(copy.folder, tmp_path / "walk")
        damage(path)
        return cli("track", tmp_path / "walk", "--model", "deutscher_2005", "--out", tmp_path / "run", "--particles", 4, "--layers", 1)

    return call


@pytest.mark.slow
@pytest.mark.parametrize("fault", LATER)
def test_images_damaged_after_the_import(damaged, fault):
    name, damage, parts = LATER[fault]
    damaged(name, damage).refuses(*parts)


@pytest.mark.slow
@pytest.mark.parametrize("fault", LOST)
def test_images_lost_after_the_import_are_frames_that_a_camera_did_not_see(damaged, tmp_path, fault):
    name, damage = LOST[fault]
    outcome = damaged(name, damage)
    assert outcome.status == 0, outcome.err
    unseen = np.argwhere(~xr.open_datatree(tmp_path / "run" / "posterior.nc")["filter"]["seen"].values.astype(bool))
    np.testing.assert_array_equal(unseen, [[int(name[-5]), 1]])


@pytest.fixture
def laboratory(tmp_path):
    """A camera with OpenCV's calibration in millimetres, and its images."""
    folder = tmp_path / "lab"
    (folder / "left").mkdir(parents=True)
    for k in range(3):
        cv2.imwrite(str(folder / "left" / f"{k:03d}.png"), np.full((120, 160), 100, np.uint8))
    file = cv2.FileStorage(str(folder / "left.yml"), cv2.FILE_STORAGE_WRITE)
    # It looks along the world's x axis, with z up, from 4 m.
    values = (
        np.array([[150.0, 0, 80], [0, 150, 60], [0, 0, 1]]),
        np.zeros(5),
        np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]),
        np.array([0, 1e3, 4e3]),
    )
    for key, value in zip(("K", "dist", "R", "T"), values, strict=True):
        file.write(key, value)
    file.release()
    return folder


SAID = ("--unit", "mm", "--up", "z", "--fps", "30")


def test_import_of_opencvs_calibration(cli, laboratory, tmp_path):
    outcome = cli("import", "opencv", laboratory, tmp_path / "walk", *SAID, "--height", "1.8", "--offset", "left=1")
    assert outcome.status == 0, outcome.err
    assert "1 camera, 2 frames at 30 frames a second" in outcome.out
    assert "note: There are no masks" in outcome.out
    picture = cv2.imread(str(tmp_path / "walk" / "check.png"))
    assert picture is not None and picture.std() > 1
    text = (tmp_path / "walk" / "session.toml").read_text()
    assert "height_m = 1.8" in text and f"{laboratory}/left/%03d.png" in text
    cli("import", "opencv", laboratory, tmp_path / "walk", *SAID).refuses("already holds a session.toml", "--overwrite")


OPTIONS = {
    "no unit": (("--up", "z", "--fps", "30"), ["--unit: not given", "expected m, cm, mm or in"]),
    "no up": (("--unit", "mm", "--fps", "30"), ["--up: not given", "expected x, y or z"]),
    "no rate": (("--unit", "mm", "--up", "z"), ["--fps: not given, and no recording states"]),
    "another unit": (("--unit", "m", "--up", "z", "--fps", "30"), ["factor of 1000"]),
    "height in mm": ((*SAID, "--height", "1800"), ["--height: 1800; expected metres", "millimetres, divide by 1000"]),
    "no such camera": ((*SAID, "--offset", "lefd=1"), ["--offset: 'lefd': no such camera; did you mean 'left'?"]),
    "no number of frames": ((*SAID, "--offset", "left"), ["--offset: 'left'; expected CAMERA=FRAMES"]),
    "twice": ((*SAID, "--offset", "left=1", "--offset", "left=2"), ["--offset: camera 'left' twice"]),
    "no masks": ((*SAID, "--masks", "nowhere"), ["nowhere/left: no numbered images in it"]),
    "no truth": ((*SAID, "--truth", "nowhere.npz"), ["nowhere.npz: no such file"]),
    "no model": ((*SAID, "--model", "nobody"), ["nobody"]),
}


@pytest.mark.parametrize("fault", OPTIONS)
def test_options_that_cannot_be(cli, laboratory, tmp_path, fault):
    arguments, parts = OPTIONS[fault]
    cli("import", "opencv", laboratory, tmp_path / "walk", *arguments).refuses(*parts)
    assert not (tmp_path / "walk").exists()


def test_options_of_bodytrack(cli, bodytrack, tmp_path):
    offsets = ("--offset", "CAM1=1", "--offset", "CAM2=1", "--offset", "CAM3=1", "--offset", "CAM4=1")
    outcome = cli("import", "parsec", bodytrack, tmp_path / "walk", "--fps", "50", *offsets, "--masks", bodytrack)
    # A folder of masks for each camera, as its images are named: here the images themselves.
    assert outcome.status == 0, outcome.err
    assert "4 cameras, 3 frames at 50 frames a second" in outcome.out
    assert "are assumed" not in outcome.out
    text = (tmp_path / "walk" / "session.toml").read_text()
    assert "first_frame = 1" in text and f'masks = "{bodytrack.resolve()}/CAM1/image%04d.bmp"' in text


@pytest.mark.slow
def test_a_range_of_bodytrack(cli, bodytrack, tmp_path):
    outcome = cli("import", "parsec", bodytrack, tmp_path / "walk", "--first-frame", 1, "--frames", 2)
    assert outcome.status == 0, outcome.err
    assert "4 cameras, 2 frames (1 to 2) at 60 frames a second" in outcome.out
    assert "note: The recording's first pose belongs to frame 0 and is left out: the session begins at frame 1." in outcome.out
    # The man is in all frames.
    assert "Nobody is detected" not in outcome.out
    text = (tmp_path / "walk" / "session.toml").read_text()
    assert "first_frame = 1" in text and "recorded = [0, 4]" in text and "angles_deg" not in text
    cli("import", "parsec", bodytrack, tmp_path / "walk", "--overwrite", "--first-frame", 4).refuses("--first-frame: 4; expected a frame of the rec")


def test_nobody_in_the_first_frame_is_said_at_the_import(cli, copy, tmp_path):
    """Of a session without a first pose: with the first later frame that shows somebody, which the same import then takes."""
    for camera in range(1, 5):
        cv2.imwrite(str(copy.image(f"FG{camera}/image0001.bmp")), np.zeros((480, 640), np.uint8))
    arguments = ("import", "parsec", copy.folder, tmp_path / "walk", "--fps", 1)
    outcome = cli(*arguments, "--first-frame", 1)
    assert outcome.status == 0, outcome.err
    assert "warning     Nobody is detected in frame 1, the first one; somebody is in frame 2: import again with --first-frame 2 --over" in outcome.out
    outcome = cli(*arguments, "--first-frame", 2, "--overwrite")
    assert outcome.status == 0 and "Nobody is detected" not in outcome.out


def test_the_verbs_are_told(cli):
    outcome = cli("import", "--help")
    assert outcome.status == 0
    assert all(verb in outcome.out for verb in ("parsec", "pose2sim", "opencv", "qualisys"))


@pytest.mark.long
def test_the_real_project_of_pose2sim(cli, pose2sim_beam, tmp_path):
    outcome = cli("import", "pose2sim", pose2sim_beam, tmp_path / "beam", "--height", "1.72")
    assert outcome.status == 0, outcome.err
    assert "4 cameras, 100 frames at 60 frames a second" in outcome.out
    assert "read as BODY_25B" in outcome.out
    assert cv2.imread(str(tmp_path / "beam" / "check.png")) is not None
