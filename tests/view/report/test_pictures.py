"""Moving pictures: which frames, how fast, how large; and that a browser's format has them all."""

import base64
import io

import numpy as np
import pytest
from PIL import Image, ImageSequence

from bayes_body.view.report import pictures
from bayes_body.view.report.pictures import MOST_FRAMES, QUALITIES, encode_animation, narrowed, picture_section, read_video


def decoded(content: bytes) -> list[tuple[float, int]]:
    """Level and milliseconds of each frame, by another reader than the one that wrote it."""
    with Image.open(io.BytesIO(content)) as image:
        assert image.info["loop"] == 0
        return [(level(np.asarray(frame.convert("RGB"))), frame.info["duration"]) for frame in ImageSequence.Iterator(image)]


def moving(html: str) -> bytes:
    return base64.b64decode(html.split('src="data:image/webp;base64,')[1].split('"')[0])


def level(picture) -> float:
    return float(np.median(picture))


@pytest.mark.parametrize(("frames", "step"), [(1, 1), (60, 1), (2 * MOST_FRAMES + 5, 3)])
def test_a_video_is_read_at_evenly_spaced_frames(tmp_path, draw_pictures, frames, step):
    draw_pictures(tmp_path, frames)
    found, fps, total = read_video(tmp_path / "overlay.mp4", 64)
    assert (fps, total) == (50.0, frames)
    assert len(found) == len(range(0, frames, step)) <= MOST_FRAMES
    np.testing.assert_allclose([level(picture) for picture in found], 25 * np.arange(0, frames, step) % 250, atol=4)


def test_an_animation_holds_every_frame_for_its_time():
    pictures = [np.full((48, 64, 3), value, np.uint8) for value in (0, 120, 240)]
    levels, durations = zip(*decoded(encode_animation(pictures, 0.1, 60)), strict=True)
    assert durations == (100, 100, 100)
    np.testing.assert_allclose(levels, [0, 120, 240], atol=3)


@pytest.mark.parametrize(
    ("frames", "fps", "told", "milliseconds"),
    [
        (10, 50.0, "Every frame of 10, slowed 4.2 times", 83),
        (10, 10.0, "Every frame of 10, in real time", 100),
        (300, 5.0, "One frame in 3 of 300, sped up 3 times", 200),
    ],
)
def test_the_time_scale_is_told_as_it_is(tmp_path, draw_pictures, frames, fps, told, milliseconds):
    draw_pictures(tmp_path, frames, fps=fps)
    html = picture_section(tmp_path, QUALITIES[0])
    assert told in html and "has all frames" in html
    # The video of a long run has every eighth frame.
    step = 24 if frames == 300 else 8
    thinned = picture_section(tmp_path, QUALITIES[0], 8 * frames)
    assert f"One frame in {step} of {8 * frames}, {told.partition(', ')[2]}" in thinned and "has one frame in 8." in thinned
    assert {shown for _, shown in decoded(moving(html))} == {milliseconds}


def test_an_animation_too_large_loses_frames_and_says_so(tmp_path, draw_pictures, monkeypatch):
    draw_pictures(tmp_path, 48, (160, 120), noise=True)
    whole = len(moving(picture_section(tmp_path, QUALITIES[0])))
    monkeypatch.setattr(pictures, "LARGEST_ANIMATION", whole // 3)
    html = picture_section(tmp_path, QUALITIES[0])
    assert len(moving(html)) <= whole // 3
    assert len(decoded(moving(html))) == 12 and "One frame in 4 of 48" in html


def test_pictures_are_never_enlarged():
    assert narrowed(np.zeros((30, 40, 3), np.uint8), 100).shape == (30, 40, 3)
    assert narrowed(np.zeros((300, 400, 3), np.uint8), 100).shape == (75, 100, 3)


def test_links_and_lists_of_files_are_not_shown(tmp_path, draw_pictures):
    """A picture of this machine, and a list that names it, in the folder of a stranger's run."""
    (tmp_path / "mine").mkdir()
    draw_pictures(tmp_path / "mine", 6)
    run = tmp_path / "run"
    (run / "overlay").mkdir(parents=True)
    (run / "overlay.mp4").symlink_to(tmp_path / "mine" / "overlay.mp4")
    (run / "overlay" / "frame_000000.png").symlink_to(tmp_path / "mine" / "overlay" / "frame_000000.png")
    assert "<img" in picture_section(tmp_path / "mine", QUALITIES[0]) and "<img" not in picture_section(run, QUALITIES[0])
    (run / "overlay.mp4").unlink()
    (run / "overlay.mp4").write_text(f"ffconcat version 1.0\nfile '{tmp_path}/mine/overlay.mp4'\n")
    assert "<img" not in picture_section(run, QUALITIES[0])
