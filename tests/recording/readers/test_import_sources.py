"""Where recordings are, which of their frames are the session's, and at which rate."""

import cv2
import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.recording.readers.assemble import align
from bayes_body.recording.readers.options import check_fps, check_height, metres_per_unit, up_axis
from bayes_body.recording.readers.sources import Source, find_background, find_series, find_source, settled_size
from bayes_body.recording.readers.videos.pairing import frame_rate

GREY = np.full((48, 64), 90, np.uint8)


def images(folder, *names):
    folder.mkdir(exist_ok=True)
    for name in names:
        cv2.imwrite(str(folder / name), GREY)
    return folder


def video(path, frames=5, fps=30.0, size=(64, 48)):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), fps, size)
    for k in range(frames):
        writer.write(np.full((*size[::-1], 3), 40 * k % 255, np.uint8))
    writer.release()
    return path


SERIES = {
    ("a0007.png", "a0008.png"): ("a%04d.png", 7, 2),
    ("cam1_9.png", "cam1_10.png", "cam1_11.png"): ("cam1_%d.png", 9, 3),
    ("100.jpg", "101.jpg"): ("%d.jpg", 100, 2),
    ("50% 0.bmp", "50% 1.bmp"): ("50%% %01d.bmp", 0, 2),
    ("099.png", "100.png"): ("%03d.png", 99, 2),
}


@pytest.mark.parametrize("names", SERIES)
def test_numbered_images(tmp_path, names):
    series = find_series(images(tmp_path / "a", *names))
    assert (series.name, series.first, series.count) == SERIES[names]
    assert [series.path(series.first + k).exists() for k in range(series.count)] == [True] * len(names)


UNEVEN = {
    ("a0.png", "a2.png"): "1 of 2 numbers .* the first is a1.png",
    ("a00.png", "a1.png"): "the first is a01.png|the first is",
    ("a0.png", "b1.png"): "images of more than one kind",
    ("a0.png", "a1.jpg"): "images of more than one kind",
    ("a0.png", "title.png"): "images of more than one kind, a....png and title.png",
    (): "no numbered images in it",
}


@pytest.mark.parametrize("names", UNEVEN)
def test_images_that_are_no_series(tmp_path, names):
    with pytest.raises(InputError, match=UNEVEN[names]):
        find_series(images(tmp_path / "a", *names))


def test_a_video_or_a_folder_of_a_cameras_name(tmp_path):
    video(tmp_path / "left.avi")
    images(tmp_path / "right", "image0003.png", "image0004.png")
    video(tmp_path / "walk_Miqus_2_26580.avi")
    left, right = find_source([tmp_path], "left"), find_source([tmp_path / "none", tmp_path], "right")
    assert (left.series, left.size_px, left.fps, left.first, left.count) == (None, (64, 48), 30.0, 0, 5)
    assert right.series is not None
    assert (right.series.name, right.size_px, right.fps, right.first, right.count) == ("image%04d.png", (64, 48), 0.0, 3, 2)
    assert find_source([tmp_path], "26580").path.name == "walk_Miqus_2_26580.avi"


def test_recordings_that_are_not_there(tmp_path):
    video(tmp_path / "cam01.avi")
    with pytest.raises(InputError, match=r"camera 'cam_01': no video .* in .*; did you mean 'cam01'\?"):
        find_source([tmp_path], "cam_01")
    images(tmp_path / "cam01", "0.png")
    with pytest.raises(InputError, match=r"cam01, cam01.avi for camera 'cam01'; expected one recording"):
        find_source([tmp_path], "cam01")
    (tmp_path / "cam02.mp4").write_bytes(b"no video")
    with pytest.raises(InputError, match=r"cam02.mp4"):
        find_source([tmp_path], "cam02")


def test_an_empty_scene(tmp_path):
    images(tmp_path / "empty", "a.png")
    video(tmp_path / "empty" / "b.avi")
    assert find_background(tmp_path / "empty", "a", (64, 48)).name == "a.png"
    assert find_background(tmp_path / "empty", "b", (64, 48)).name == "b.avi"
    for name in "ab":
        with pytest.raises(InputError, match="64 x 48 pixels; expected 60 x 48"):
            find_background(tmp_path / "empty", name, (60, 48))
    with pytest.raises(InputError, match="no image or video for camera 'c'"):
        find_background(tmp_path / "empty", "c", (64, 48))


def test_only_a_codecs_padding_may_be_missing(tmp_path):
    def settled(calibrated_px, size_px):
        return settled_size("camera 'a'", calibrated_px, Source(tmp_path / "a.mp4", None, size_px, 30.0, 0, 1))

    assert settled(None, (1080, 1920)) is settled((1080, 1920), (1080, 1920)) is None
    remark = settled((1088, 1920), (1080, 1920))
    assert remark is not None and "calibrated at 1088 x 1920, the recording has 1080 x 1920" in remark
    assert settled((1088, 1088), (1080, 1080)) is not None
    assert settled((1088, 1920), (1088, 1912)) is not None
    for other in [(1920, 1080), (1072, 1920), (540, 960), (1096, 1920)]:
        with pytest.raises(InputError, match=r"a.mp4 has .* pixels; expected 1088 x 1920, as in its calibration"):
            settled((1088, 1920), other)
    with pytest.raises(InputError, match="expected 1080 x 1920"):
        settled((1080, 1920), (1088, 1920))


def test_frames_that_all_cameras_have():
    timing = align({"a": (0, 100), "b": (0, 98)}, {})
    assert (timing.frames, timing.first_frame, timing.offsets) == (98, 0, {"a": 0, "b": 0})
    assert "(a 100, b 98): the session has the 98 that all have" in timing.remarks[0]
    # Images are counted from 1, the video from 0; b is three frames ahead.
    timing = align({"a": (1, 100), "b": (0, 100)}, {"b": 3})
    assert (timing.frames, timing.first_frame, timing.offsets) == (97, 1, {"a": 0, "b": 2})


@pytest.mark.parametrize("offsets", [{}, {"b": 3}, {"a": -2}, {"a": -2, "b": -5, "c": 1}, {"c": -7, "b": 40}])
def test_the_same_instant_in_every_camera(offsets):
    # What a camera recorded at its own k-th frame happened at time k - offset: within a session frame all times agree, and no frame is wasted.
    counts = {"a": (0, 100), "b": (5, 97), "c": (1, 120)}
    timing = align(counts, offsets)
    own = {name: timing.first_frame + timing.offsets[name] - first for name, (first, _) in counts.items()}
    assert len({own[name] - offsets.get(name, 0) for name in counts}) == 1
    assert min(own.values()) == 0 or min(offsets.values(), default=0) >= 0
    assert all(first >= 0 for first in own.values())
    assert timing.frames == min(count - own[name] for name, (_, count) in counts.items())


def test_offsets_that_leave_nothing():
    with pytest.raises(InputError, match="camera 'b': 10 frames, all before the session's first"):
        align({"a": (0, 100), "b": (0, 10)}, {"b": 10})
    with pytest.raises(InputError, match=r"--offset: 'cam3': no such camera; did you mean 'cam1'\?"):
        align({"cam1": (0, 100)}, {"cam3": 1})


def test_frame_rates():
    assert frame_rate({"a": 59.94, "b": 59.9401}, None) == (pytest.approx(59.94005), [])
    assert frame_rate({"a": 0.0, "b": 25.0}, None) == (25.0, [])
    assert frame_rate({"a": 0.0}, 120.0) == (120.0, [])
    rate, (remark,) = frame_rate({"a": 30.0, "b": 240.0}, 240.0)
    assert rate == 240.0 and remark == "--fps 240 overrides the videos' rates (a 30)."
    with pytest.raises(InputError, match=r"frame rate: cameras differ: a 30, b 29.97"):
        frame_rate({"a": 30.0, "b": 29.97}, None)
    with pytest.raises(InputError, match="--fps: not given"):
        frame_rate({"a": 0.0}, None)


@pytest.mark.parametrize(
    ("height", "remedy"),
    [(1800.0, "millimetres, divide by 1000"), (180.0, "centimetres, divide by 100"), (5.9, "stature in metres"), (0.0, "stature")],
)
def test_heights_that_are_no_metres(height, remedy):
    check_height(1.8)
    check_height(None)
    with pytest.raises(InputError, match=f"--height: {height:g}; expected metres, above 0 and at most 3; .*{remedy}"):
        check_height(height)


def test_words_of_the_options():
    assert metres_per_unit("cm", "") == 0.01
    assert up_axis("y", "") == "y"
    with pytest.raises(InputError, match=r"--unit: not given; nobody knows; expected m, cm, mm or in; give .* --unit mm"):
        metres_per_unit(None, "nobody knows")
    with pytest.raises(InputError, match=r"--unit: 'inch': no such unit; did you mean .in.\?"):
        metres_per_unit("inch", "")
    with pytest.raises(InputError, match=r"--up: '-y'; expected x, y or z"):
        up_axis("-y", "")
    for rate in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(InputError, match="--fps"):
            check_fps(rate)
