"""Videos: the same bits however a frame is reached, and sentences about those that cannot be used."""

import os
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.recording.readers.images import NotSeenError
from bayes_body.recording.readers.videos.video import damaged_frames, probe, read_video_frame, readable_frames

SIZE, FRAMES, RATE = (96, 64), 100, 50.0


def write(path: Path, code: str, frames: int = FRAMES) -> Path:
    """A video of drifting blobs."""
    blobs = cv2.GaussianBlur(np.random.default_rng(4).integers(0, 256, (*SIZE[::-1], 3)).astype(np.uint8), (0, 0), 4)
    blobs = cv2.normalize(blobs, None, 0, 255, cv2.NORM_MINMAX)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*code), RATE, SIZE)
    for frame in range(frames):
        writer.write(np.roll(blobs, 3 * frame, axis=1))
    writer.release()
    return path


def decoded(path: Path) -> list[np.ndarray]:
    """All frames, read straight through by OpenCV."""
    capture, images = cv2.VideoCapture(str(path)), []
    while True:
        found, image = capture.read()
        if not found:
            return images
        images.append(image)


@pytest.fixture(params=[("mp4", "mp4v"), ("avi", "MJPG")])
def video(request, tmp_path) -> Path:
    """Written by OpenCV: one with frames that depend on others, one without."""
    return write(tmp_path / f"video.{request.param[0]}", request.param[1])


@pytest.fixture
def cut(tmp_path) -> Path:
    """A video whose container names 100 frames and whose end is gone."""
    path = write(tmp_path / "cut.avi", "MJPG")
    content = path.read_bytes()
    path.write_bytes(content[: int(0.57 * len(content))])
    return path


def test_probe(video):
    assert probe(video) == (SIZE, RATE, FRAMES)


def test_sequential_reading_and_jumps_give_the_same_bits(video):
    expected = decoded(video)
    assert len(expected) == FRAMES
    for number in range(FRAMES):
        np.testing.assert_array_equal(read_video_frame(video, number), expected[number])
    for number in np.random.default_rng(1).permutation(FRAMES):
        np.testing.assert_array_equal(read_video_frame(video, int(number)), expected[number], err_msg=f"frame {number}")


def test_a_far_frame_first_and_then_backwards(video):
    expected = decoded(video)
    for number in (97, 96, 3, 3, 60, 0):
        np.testing.assert_array_equal(read_video_frame(video, number), expected[number], err_msg=f"frame {number}")


@pytest.mark.long
def test_every_frame_of_a_real_video_both_ways(pose2sim_beam):
    path = pose2sim_beam / "videos" / "cam01.mp4"
    expected = [image[::16, ::16] for image in decoded(path)]
    assert probe(path) == ((1080, 1920), 60.0, len(expected))
    order = [*range(len(expected)), *np.random.default_rng(2).permutation(len(expected))[:15]]
    for number in order:
        np.testing.assert_array_equal(read_video_frame(path, int(number))[::16, ::16], expected[number], err_msg=f"frame {number}")


def test_an_image_may_be_drawn_on(video):
    first = read_video_frame(video, 5)
    first[:] = 0
    assert read_video_frame(video, 5).any()


def test_threads_read_what_one_reads(video):
    expected, wrong = decoded(video), []

    def walk(start: int) -> None:
        wrong.extend(number for number in range(start, FRAMES, 3) if not np.array_equal(read_video_frame(video, number), expected[number]))

    threads = [threading.Thread(target=walk, args=(start,)) for start in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []


def test_a_file_written_anew_is_read_anew(tmp_path):
    path = write(tmp_path / "video.avi", "MJPG")
    read_video_frame(path, 0)
    write(path, "MJPG", 7)
    os.utime(path, ns=(1, 1))
    assert probe(path).frames == 7


def test_a_video_cut_short_is_seen_up_to_its_end(cut):
    end = len(decoded(cut))
    assert 40 < end < 70
    assert probe(cut).frames == FRAMES
    assert [readable_frames(cut, frames) for frames in (10, end, end + 1, FRAMES)] == [10, end, end, end]
    read_video_frame(cut, end - 2)
    # Half of it is there, and the decoder makes up the rest.
    with pytest.raises(NotSeenError, match=f"frame {end - 1} is damaged; expected a frame that can be decoded without errors; copy the file again"):
        read_video_frame(cut, end - 1)
    with pytest.raises(NotSeenError, match=f"frame {end} cannot be read, the video ends after {end} frames; expected more than {end}; copy the file"):
        read_video_frame(cut, end)
    # The end does not spoil what comes before it.
    np.testing.assert_array_equal(read_video_frame(cut, 2), decoded(cut)[2])


# In the middle of the file, 4 kB: about the bytes of two frames.
WHAT = {"zeros": bytes(4000), "ones": b"\xff" * 4000, "noise": np.random.default_rng(3).bytes(4000)}


@pytest.mark.parametrize("what", WHAT)
def test_bytes_overwritten_in_the_middle_are_noticed(video, what):
    assert damaged_frames(video, range(FRAMES)) == []
    expected, content = decoded(video), bytearray(video.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 4000] = WHAT[what]
    video.write_bytes(content)
    damaged = damaged_frames(video, range(FRAMES))
    assert damaged and 30 < damaged[0] < 60
    with pytest.raises(NotSeenError, match=f"{video.name}: frame {damaged[0]} is damaged; expected a frame that can be decoded without errors"):
        read_video_frame(video, damaged[0])
    # A frame that is not damaged is what it was.
    for number in sorted({*range(FRAMES)} - {*damaged}):
        np.testing.assert_array_equal(read_video_frame(video, number), expected[number], err_msg=f"frame {number}")


@pytest.mark.slow
def test_real_videos_are_sound_and_damage_in_them_is_noticed(pose2sim_beam, tmp_path):
    path = pose2sim_beam / "videos" / "cam01.mp4"
    assert damaged_frames(path, range(100)) == []
    content = bytearray(path.read_bytes())
    content[len(content) // 2 : len(content) // 2 + 20_000] = bytes(20_000)
    (tmp_path / "damaged.mp4").write_bytes(content)
    damaged = damaged_frames(tmp_path / "damaged.mp4", range(100))
    # The video has one key frame, its first: damage lasts.
    assert 40 < damaged[0] < 70 and damaged == list(range(damaged[0], 100))


def test_readable_frames_of_a_whole_video(video):
    assert [readable_frames(video, frames) for frames in (1, FRAMES, FRAMES + 5)] == [1, FRAMES, FRAMES]


def test_another_size(video):
    with pytest.raises(InputError, match="96 x 64 pixels; expected 640 x 480 as its camera has") as error:
        read_video_frame(video, 0, (640, 480))
    assert not isinstance(error.value, NotSeenError)


def test_no_video(tmp_path, capfd):
    (tmp_path / "text.mp4").write_text("hello" * 100)
    (tmp_path / "empty.mp4").touch()
    whole = write(tmp_path / "whole.mp4", "mp4v").read_bytes()
    (tmp_path / "half.mp4").write_bytes(whole[: len(whole) // 2])
    faults = {
        "text.mp4": "not a video",
        "empty.mp4": "not a video",
        "half.mp4": "not a video that FFmpeg can read, or cut short",
        "none.mp4": "no such file",
    }
    for name, found in faults.items():
        for use in (probe, lambda path: read_video_frame(path, 0), lambda path: readable_frames(path, 3)):
            with pytest.raises(InputError, match=f"{name}: {found}.*; expected a .*; (restore|copy)") as error:
                use(tmp_path / name)
            assert not isinstance(error.value, NotSeenError)
    with pytest.raises(InputError, match="frame -1; expected 0 or later; correct first_frame"):
        read_video_frame(tmp_path / "whole.mp4", -1)
    assert capfd.readouterr().err == ""


def test_a_video_without_frames(tmp_path):
    path = write(tmp_path / "none.avi", "MJPG", 1)
    content = path.read_bytes()
    path.write_bytes(content[: content.index(b"movi") + 4])
    with pytest.raises(InputError, match=r"none.avi: (a video without a frame|no video)"):
        probe(path)
