"""`bayes-body import`: a session, a picture to check it by, and sentences about what is wrong with a recording."""

import cv2
import numpy as np
import pytest


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
    "no rotation": (lambda numbers: [*numbers[:10], "0.5", *numbers[11:]], ["numbers 11 to 19", "no rotation", "expected"]),
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
    "missing": ("CAM2/image0002.bmp", _missing, ["CAM2", "image0002.bmp", "missing", "restore"]),
    "truncated": ("CAM2/image0003.bmp", _truncated, ["CAM2/image0003.bmp", "cut short", "expected a whole image"]),
    "truncated between": ("CAM2/image0002.bmp", _truncated, ["CAM2/image0002.bmp", "cut short", "expected a whole image"]),
    "another size": ("CAM1/image0003.bmp", _small, ["CAM1/image0003.bmp", "20 x 10", "expected 640 x 480", "scale focal_px"]),
    "masks of another size": ("FG4/image0001.bmp", _small, ["FG4/image0001.bmp", "20 x 10", "expected 640 x 480"]),
}


@pytest.mark.parametrize("fault", LATER)
def test_images_damaged_after_the_import(cli, copy, tmp_path, fault):
    from bayes_body.recording.parsec import import_parsec

    name, damage, parts = LATER[fault]
    path = copy.image(name)
    import_parsec(copy.folder, tmp_path / "walk")
    damage(path)
    cli("track", tmp_path / "walk", "--out", tmp_path / "run", "--particles", 4, "--layers", 1).refuses(*parts)
