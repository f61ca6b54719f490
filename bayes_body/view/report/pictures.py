"""Stills and a moving picture of the run's overlay, small enough for a page. An animated WebP needs no controls; on paper a still replaces it."""

import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from cv2.typing import MatLike

from bayes_body.base.errors import InputError
from bayes_body.recording.readers.videos.stream import open_video, picture_of
from bayes_body.view.report.figures import data_uri, webp_uri
from bayes_body.view.report.markup import Markup, Picture, details, figures, section, tag

ABOUT = (
    "The mean is a translucent body: left side blue, right side orange, middle green. Draws are thin light outlines over it. Where the mean is not "
    "among the draws, as between two modes, the body is the medoid of the draws, and the picture says so."
)
LARGEST_ANIMATION = 4_000_000
MOST_FRAMES = 100
# Pixels; WebP takes 16383.
TALLEST = 4000
# Shortest and longest time for which a frame is shown, seconds. Between them the animation runs in real time.
SHOWN = (1 / 12, 1 / 5)


class Quality(NamedTuple):
    """Quality of the pictures: widths in pixels, and WebP's quality (up to 100)."""

    still_width: int
    still_quality: int
    width: int
    moving: int


# From best to worst; the page uses the first for which it is small enough.
QUALITIES = (Quality(1920, 70, 960, 50), Quality(1280, 70, 960, 50), Quality(960, 60, 800, 40), Quality(800, 50, 640, 30), Quality(640, 40, 480, 20))


def picture_section(folder: Path, quality: Quality | None, run_frames: int | None = None) -> Markup:
    """Return the section with the overlay's pictures; a sentence replaces each picture that is missing in the run's folder.

    Args:
        folder: the run's folder.
        quality: quality of the pictures; None leaves them out.
        run_frames: number of frames of the run; those of the video by default.
    """
    if quality is None:
        return section("pictures", "Pictures", tag("p", "The pictures are left out: with them the page would be too large."))
    stills = read_stills(folder / "overlay", quality)
    video = _animation(folder / "overlay.mp4", quality, run_frames)
    parts: list[str] = [tag("p", ABOUT)]
    parts += [figures([video], "moving")] if video else [tag("p", "overlay.mp4 is missing or cannot be read: there is no moving picture.")]
    parts += [figures(stills[:1], "large")] if stills else [tag("p", "There are no stills in overlay/.")]
    parts += [details(f"{len(stills) - 1} more", figures(stills[1:], "large"))] if len(stills) > 1 else []
    command = tag("code", f"bayes-body view {shlex.quote(folder.resolve().name)}")
    # No link: the page has scripts, and in a stranger's folder they are the stranger's.
    scene = tag("p", command, " makes a page on which this run can be turned and played in 3D.", class_="note")
    return section("pictures", "Pictures", *(parts if video or stills else parts[1:]), scene)


def read_stills(folder: Path, quality: Quality) -> list[Picture]:
    """Return the stills of an overlay's folder that can be read."""
    return list(_stills(folder, quality))


def _stills(folder: Path, quality: Quality) -> Iterator[Picture]:
    for path in sorted(folder.glob("frame_*.png")):
        image = _read(path)
        if image is not None:
            name = path.stem.removeprefix("frame_").lstrip("0") or "0"
            yield _picture(_still_uri(image, quality), f"Frame {name}: the recording with the posterior drawn over it.", f"Frame {name}")


def _read(path: Path) -> MatLike | None:
    """Return the picture; None if it is a link, cannot be read, or is larger than OpenCV reads."""
    try:
        return None if path.is_symlink() or not path.is_file() else cv2.imread(str(path))
    except cv2.error:
        return None


def _picture(uri: str, alt: str, caption: str, still_uri: str | None = None) -> Picture:
    return Picture(uri, alt, caption, inverts=False, still_uri=still_uri)


def _still_uri(image: MatLike, quality: Quality) -> str:
    return webp_uri(narrowed(image, quality.still_width), quality.still_quality)


def narrowed(image: MatLike, width: int) -> MatLike:
    """Return the image, scaled down to at most that width, and to at most TALLEST."""
    scale = min(width / image.shape[1], TALLEST / image.shape[0])
    if scale >= 1:
        return image
    size = (max(round(image.shape[1] * scale), 1), max(round(image.shape[0] * scale), 1))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def _animation(path: Path, quality: Quality, run_frames: int | None) -> Picture | None:
    """Return a moving WebP of at most LARGEST_ANIMATION bytes; every other frame is dropped, repeatedly, until it is that small."""
    frames, fps, total = read_video(path, quality.width)
    if len(frames) < 2:
        return None
    step = -(-total // MOST_FRAMES)
    while True:
        seconds = float(np.clip(step / fps, *SHOWN))
        content = encode_animation(frames, seconds, quality.moving)
        if len(content) <= LARGEST_ANIMATION or len(frames) < 4:
            break
        frames, step = frames[::2], 2 * step
    pace = _pace(seconds * fps / step)
    drawn = -(-(run_frames or total) // total)
    extent = "has all frames" if drawn == 1 else f"has one frame in {drawn}"
    shown = "Every frame" if step * drawn == 1 else f"One frame in {step * drawn}"
    caption = f"{shown} of {total if drawn == 1 else run_frames}, {pace}. overlay.mp4 in the run's folder {extent}."
    return _picture(
        data_uri("image/webp", content), "The recording with the posterior drawn over it, moving.", caption, _still_uri(frames[0], quality)
    )


def _pace(slower: float) -> str:
    if abs(slower - 1) < 0.05:
        return "in real time"
    return f"slowed {slower:.2g} times" if slower > 1 else f"sped up {1 / slower:.2g} times"


def _is_mp4(path: Path) -> bool:
    """Return whether a file is an mp4 itself. A link, or a list of other files, could show any file of this machine."""
    if path.is_symlink() or not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(8)[4:] == b"ftyp"


def read_video(path: Path, width: int, most: int = MOST_FRAMES) -> tuple[list[MatLike], float, int]:
    """Return frames of a video, its frames a second, and its number of frames.

    The frames are evenly spaced, at most `most` of them, and at most `width` pixels wide. If the video cannot be read, there are none.
    """
    if not _is_mp4(path):
        return [], 0.0, 0
    try:
        video, _ = open_video(path)
    except InputError:
        return [], 0.0, 0
    total, fps = video.stated_frames, video.fps
    step, frames = max(-(-total // most), 1), []
    try:
        # Seeking in an mp4 reaches key frames only. Therefore all frames are decoded, but only few become pictures.
        for place, outcome in enumerate(video.outcomes if fps > 0 else ()):
            if len(frames) == most:
                break
            if place % step == 0 and outcome.frame is not None:
                frames.append(narrowed(picture_of(outcome.frame), width))
    finally:
        video.close()
    return frames, fps, total


def encode_animation(frames: list[MatLike], seconds: float, quality: int) -> bytes:
    """Return a WebP that shows each frame for that many seconds, in an endless loop."""
    animation = cv2.Animation()
    animation.frames = frames
    animation.durations = [round(1000 * seconds)] * len(frames)
    animation.loop_count = 0
    done, content = cv2.imencodeanimation(".webp", animation, [cv2.IMWRITE_WEBP_QUALITY, quality])
    if not done:
        raise RuntimeError("OpenCV could not encode an animated WebP")
    return content.tobytes()
