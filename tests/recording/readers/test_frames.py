"""Frames of a session, cameras that did not see one, and reading ahead."""

import dataclasses
import shutil

import cv2
import jax
import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.model.build import build_model
from bayes_body.recording.observation import frames
from bayes_body.recording.observation.frames import Frame, cameras_with_picture, read_frame
from bayes_body.recording.observation.pictures import read_colour
from bayes_body.recording.readers.parsec import import_parsec
from bayes_body.results.metrics.fit import frame_fit
from bayes_body.tracking.observations import observations


def test_real_frames(bodytrack, tmp_path):
    session, _ = import_parsec(bodytrack, tmp_path)
    frame = read_frame(session, 3)
    assert frame.index == 3
    assert frame.seen == (True,) * 4
    assert frame.largest == (480, 640)
    assert frame.masks is not None and frame.foreground is not None
    assert len(frame.images) == len(frame.masks) == 4
    for image, mask, foreground in zip(frame.images, frame.masks, frame.foreground, strict=True):
        assert image.shape == mask.shape == (480, 640)
        assert foreground.dtype == np.float32
        np.testing.assert_array_equal(foreground, mask)
    with pytest.raises(InputError, match="frame 4; expected 0 to 3"):
        read_frame(session, 4)


@pytest.fixture
def spoilt(textured_session, tmp_path):
    """A copy of two cameras' images and masks."""
    folder = tmp_path / "blobs"
    shutil.copytree(textured_session.folder, folder)
    return dataclasses.replace(textured_session, folder=folder)


def _black(path):
    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 4, (120, 160)).astype(np.uint8))


UNSEEN = {
    "missing": lambda path: path.unlink(),
    "cut short": lambda path: path.write_bytes(path.read_bytes()[:300]),
    "no image": lambda path: path.write_text("hello"),
    "black": _black,
}


@pytest.mark.parametrize("fault", UNSEEN)
def test_a_camera_that_did_not_see(spoilt, fault):
    UNSEEN[fault](spoilt.folder / "a" / "image0002.png")
    frame = read_frame(spoilt, 2)
    assert frame.seen == (False, True)
    for entries in (frame.images, frame.masks, frame.foreground):
        assert entries[0] is None and entries[1].shape == (144, 128)
    assert frame.largest == read_frame(spoilt, 1).largest == (144, 160)
    assert read_colour(spoilt, 2, spoilt.views[0]) is None
    assert read_frame(spoilt, 1).seen == (True, True)


def test_images_are_read_when_asked_for_if_it_is_known_who_sees(spoilt):
    frame = read_frame(spoilt, 2, seen=(True, False))
    assert frame.images[1] is None and frame.masks[1] is None
    image = cv2.imread(str(spoilt.folder / "a" / "image0002.png"), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(spoilt.folder / "a" / "image0002.png"), 255 - image)
    np.testing.assert_array_equal(frame.images[0], 255 - image)
    _black(spoilt.folder / "a" / "image0002.png")
    np.testing.assert_array_equal(frame.images[0], 255 - image)


def test_a_mask_alone_that_is_missing(spoilt):
    (spoilt.folder / "b" / "mask0001.png").unlink()
    frame = read_frame(spoilt, 1)
    assert frame.seen == (True, True)
    assert frame.masks[1] is None and frame.foreground[1] is None
    assert frame.masks[0] is not None


def test_an_image_of_another_size_is_an_error(spoilt):
    cv2.imwrite(str(spoilt.folder / "a" / "image0002.png"), np.eye(100, dtype=np.uint8) * 255)
    with pytest.raises(InputError, match="100 x 100 pixels; expected 160 x 120"):
        read_frame(spoilt, 2)


def test_masks_are_read_when_they_are_looked_at(spoilt):
    frame = read_frame(spoilt, 0)
    shutil.rmtree(spoilt.folder)
    assert frame.images[0] is not None
    assert frame.masks[0] is None


def test_too_few_frames_for_silhouettes(spoilt):
    views = tuple(dataclasses.replace(view, masks=None) for view in spoilt.views)
    frame = read_frame(dataclasses.replace(spoilt, views=views), 0)
    assert frame.masks is None and frame.foreground is None and frame.seen == (True, True)


def test_a_frame_knows_the_frame_before_if_asked(spoilt):
    rotations = np.stack([np.eye(3), np.diag([1.0, -1, -1]), np.diag([-1.0, -1, 1])])
    np.savez(spoilt.folder / "path.npz", rotation=rotations, translation_m=np.arange(9.0).reshape(3, 3))
    first, *others = spoilt.views
    session = dataclasses.replace(spoilt, frames=3, views=(dataclasses.replace(first, path="path.npz"), *others))
    frame, alone = read_frame(session, 2, with_before=True), read_frame(session, 1)
    assert frame.before is not None and frame.before.index == 1 and frame.before.before is None
    for image, expected in zip(frame.before.images, alone.images, strict=True):
        np.testing.assert_array_equal(image, expected)
    np.testing.assert_array_equal([each.cameras[0].translation_m for each in (frame, frame.before)], [[6, 7, 8], [3, 4, 5]])
    assert alone.before is None and read_frame(session, 0, with_before=True).before is None


def test_the_size_of_a_frame_made_by_hand():
    assert Frame(0, (np.zeros((4, 9), np.uint8), None, np.zeros((7, 5), np.uint8)), None).largest == (7, 9)


@pytest.fixture
def filmed(textured_session, tmp_path):
    """A session of one video of ten frames, the camera being one frame ahead of the session, which wants twelve."""
    camera = textured_session.views[0].camera
    writer = cv2.VideoWriter(str(tmp_path / "a.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, camera.size_px)
    for level in range(10):
        image = np.zeros((*camera.size_px[::-1], 3), np.uint8)
        # Frame 4 of the video is black.
        image[:, 20 * (level != 4) : 80 * (level != 4)] = (40, 20 * level, 200)
        writer.write(image)
    writer.release()
    view = dataclasses.replace(textured_session.views[0], images=None, masks=None, video="a.avi", offset=1)
    return dataclasses.replace(textured_session, folder=tmp_path, views=(view,), frames=12)


def test_a_video_is_seen_up_to_its_end(filmed):
    assert [read_frame(filmed, index).seen[0] for index in range(12)] == [index not in (3, 9, 10, 11) for index in range(12)]
    assert abs(int(read_colour(filmed, 5, filmed.views[0])[60, 50, 1]) - 120) < 8


def test_without_decoding_a_black_frame_counts_as_a_picture(filmed):
    assert [cameras_with_picture(filmed, index) for index in range(12)] == [(index < 9,) for index in range(12)]
    with pytest.raises(InputError, match="frame 12; expected 0 to 11"):
        cameras_with_picture(filmed, 12)


def test_a_model_of_keypoints_reads_no_picture(keypoint_session, monkeypatch):
    model = build_model("keypoints", keypoint_session)
    expected = [read_frame(keypoint_session, index) for index in range(keypoint_session.frames)]
    data, pose = [model.observe(frame) for frame in expected], np.asarray(model.initial[model.body.variable], float)[None]
    fit = frame_fit(keypoint_session, model, pose, 0)

    def refuse(*_):
        raise AssertionError("a picture is read")

    for name in ("read_greys", "read_colour", "read_mask"):
        monkeypatch.setattr(frames, name, refuse)
    for observed, frame, arrays in zip(observations(keypoint_session, model, range(len(expected))), expected, data, strict=True):
        assert observed.seen.tolist() == list(frame.seen)
        jax.tree.map(np.testing.assert_array_equal, observed.data, arrays)
    judged = frame_fit(keypoint_session, model, pose, 0, to_judge=True)
    np.testing.assert_array_equal(judged.distance, fit.distance)
    assert np.isnan(judged.overlap).all() and not np.isnan(fit.overlap).any()
    with pytest.raises(AssertionError, match="a picture is read"):
        next(observations(keypoint_session, build_model("silhouettes", keypoint_session), range(1)))
