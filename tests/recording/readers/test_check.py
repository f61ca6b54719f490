"""The check of a whole session, on a damaged copy of the real recording and on videos."""

import dataclasses

import cv2
import numpy as np
import pytest

from bayes_body.base.errors import FaultyFileError
from bayes_body.recording.readers.check import check_session, named
from bayes_body.recording.readers.parsec import import_parsec
from bayes_body.recording.session.session import View


@pytest.fixture
def damaged(copy, tmp_path):
    """A good session whose images of CAM2 and FG2 can then be spoilt."""
    folders = copy.own("CAM2"), copy.own("FG2")
    session, _ = import_parsec(copy.folder, tmp_path / "session")
    return session, *folders


def sentences(session) -> tuple[str, ...]:
    with pytest.raises(FaultyFileError) as error:
        check_session(session)
    return error.value.sentences


def spoil(path, content: bytes) -> None:
    path.unlink()
    path.write_bytes(content)


def test_a_whole_session_has_no_remarks(damaged):
    assert check_session(damaged[0]) == []


def test_missing_images_are_one_remark_a_camera(damaged):
    session, images, masks = damaged
    for number in (1, 2):
        (images / f"image000{number}.bmp").unlink()
    (masks / "image0000.bmp").unlink()
    assert check_session(session) == [
        "camera 'CAM2': 2 of 4 images are missing (frames 1-2): the camera counts as not seeing the person there; "
        "restore them, or correct images, first_frame and frames in session.toml.",
        "camera 'CAM2': 1 of 4 masks is missing (frame 0): the camera counts as not seeing the person there; "
        "restore them, or correct masks, first_frame and frames in session.toml.",
    ]


def test_a_series_that_is_missing_is_an_error(damaged):
    session, images, _ = damaged
    for path in images.iterdir():
        path.unlink()
    (sentence,) = sentences(session)
    assert "camera 'CAM2': all 4 images are missing, the first is" in sentence
    assert "CAM2/image0000.bmp; expected a file for every frame; restore them, or correct images, first_frame and frames" in sentence


def test_last_image_cut_short_is_a_remark_and_a_mask_of_another_size_an_error(damaged):
    session, images, masks = damaged
    spoil(images / "image0003.bmp", (images / "image0003.bmp").read_bytes()[:5000])
    (remark,) = check_session(session)
    assert "camera 'CAM2': " in remark
    assert "CAM2/image0003.bmp: cut short, 303278 of 308278 bytes are missing" in remark
    assert remark.endswith("in this frame the camera counts as not seeing the person.")
    (masks / "image0003.bmp").unlink()
    cv2.imwrite(str(masks / "image0003.bmp"), np.zeros((100, 200), np.uint8))
    (size,) = sentences(session)
    assert "FG2/image0003.bmp: 200 x 100 pixels; expected 640 x 480 as its camera has; use the images" in size


def test_a_first_image_that_is_none_is_an_error(damaged):
    session, images, _ = damaged
    spoil(images / "image0000.bmp", b"hello")
    (sentence,) = sentences(session)
    assert "CAM2/image0000.bmp: not an image that OpenCV can read" in sentence


@pytest.fixture
def filmed(textured_session, tmp_path):
    """`filmed(frames=..., **fields)`: a session of one camera with a video of 12 frames."""
    camera = textured_session.views[0].camera
    writer = cv2.VideoWriter(str(tmp_path / "a.avi"), cv2.VideoWriter.fourcc(*"MJPG"), textured_session.fps, camera.size_px)
    for level in range(12):
        image = np.full((*camera.size_px[::-1], 3), 40, np.uint8)
        image[level : level + 30] = 200
        writer.write(image)
    writer.release()

    def make(frames: int, first_frame: int = 0, **fields):
        view = View(dataclasses.replace(camera, **fields.pop("camera", {})), video="a.avi", **fields)
        return dataclasses.replace(textured_session, folder=tmp_path, views=(view,), frames=frames, first_frame=first_frame)

    return make


def test_a_video_that_ends_early_is_a_remark(filmed):
    assert check_session(filmed(12)) == check_session(filmed(10, offset=2)) == []
    (remark,) = check_session(filmed(12, offset=2))
    assert check_session(filmed(12, offset=2), decode=False) == [remark]
    assert "camera 'a': 2 of 12 frames are missing (frames 10-11), " in remark
    assert (
        "a.avi ends before them: the camera counts as not seeing the person there; copy the video again, or correct first_frame and frames" in remark
    )


def test_another_frame_rate_is_noticed(filmed):
    session = filmed(12)
    at = [dataclasses.replace(session, fps=session.fps * factor) for factor in (1.0003, 1.001, 0.5)]
    assert check_session(at[0]) == []
    (remark,) = check_session(at[1])
    assert "a.avi: 60 frames per second, and 60.06 in session.toml: after 17 s the session's times are one frame off; correct fps" in remark
    (sentence,) = sentences(at[2])
    assert "a.avi: 60 frames per second; expected 30, fps in session.toml; name the right video, or correct fps" in sentence
    # A slow-motion video.
    slow = dataclasses.replace(at[2], views=tuple(dataclasses.replace(view, video_fps=session.fps) for view in session.views))
    assert check_session(slow) == []
    (sentence,) = sentences(dataclasses.replace(slow, views=tuple(dataclasses.replace(view, video_fps=25.0) for view in slow.views)))
    assert "a.avi: 60 frames per second; expected 25, video_fps of camera 'a' in session.toml" in sentence


def test_damaged_frames_are_a_remark(filmed, tmp_path):
    content = bytearray((tmp_path / "a.avi").read_bytes())
    middle = content.index(b"00dc", len(content) // 2)
    number = content[content.index(b"movi") : middle].count(b"00dc")
    size = int.from_bytes(content[middle + 4 : middle + 8], "little")
    content[middle + 8 : middle + 8 + size] = b"\xff" * size
    (tmp_path / "a.avi").write_bytes(content)
    (remark,) = check_session(filmed(12))
    assert remark.startswith(f"camera 'a': 1 of 12 frames cannot be decoded without errors (frame {number}), ")
    assert remark.endswith("a.avi is damaged: the camera counts as not seeing the person there; copy the video again.")
    # Of frames that are not used nothing is said.
    assert check_session(filmed(12), number) == []
    # Nor if no pictures are read.
    assert check_session(filmed(12), decode=False) == []


def test_a_video_that_cannot_be_used_is_an_error(filmed, tmp_path):
    assert "a.avi has 12 frames; expected more than 30, the number of the first" in sentences(filmed(3, first_frame=30))[0]
    assert "a.avi: 160 x 120 pixels; expected 100 x 120 as its camera has" in sentences(filmed(3, camera={"size_px": (100, 120)}))[0]
    (tmp_path / "a.avi").unlink()
    assert "a.avi: no such file; expected a video" in sentences(filmed(3))[0]


def test_the_empty_scene_is_looked_at(filmed, tmp_path):
    cv2.imwrite(str(tmp_path / "empty.png"), np.zeros((120, 160), np.uint8))
    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((60, 80), np.uint8))
    assert check_session(filmed(3, background="empty.png")) == check_session(filmed(3, background="a.avi")) == []
    assert "small.png: 80 x 60 pixels; expected 160 x 120 as its camera has" in sentences(filmed(3, background="small.png"))[0]
    assert "none.png: no such file" in sentences(filmed(3, background="none.png"))[0]


def test_frames_are_named_in_ranges():
    assert [named(frames) for frames in ([4], [1, 2, 3], [0, 2, 3, 9])] == ["frame 4", "frames 1-3", "frames 0, 2-3, 9"]
