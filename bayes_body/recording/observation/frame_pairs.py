"""What is wrong with a recording for a likelihood that compares frames: frames that repeat, and a camera that moves although no path is given."""

from collections.abc import Callable, Iterable

import cv2
import numpy as np

from bayes_body.recording.observation.image_motion import corner_ways
from bayes_body.recording.observation.pictures import Greys, read_greys
from bayes_body.recording.readers.check import named
from bayes_body.recording.session.session import Session, View

# Of two different frames, more than this share of the pixels differ by more than so many grey levels: by noise, or because someone moves. A frame
# that was repeated before the video was compressed differs by less.
REPEATED_SHARE, REPEATED_LEVELS = 0.001, 2
# The background of a camera that stands still moves by less, in pixels per frame.
STILL_PX = 0.5
# Pairs of frames that are looked at for a moving camera.
PAIRS = 12


def pair_sentences(session: Session, frames: int, watch: Callable[[range], Iterable[int]] = iter) -> list[str]:
    """Return a sentence for each camera whose pictures mislead a likelihood that compares a frame with the one before.

    Args:
        session: the recording.
        frames: number of frames, from the first.
        watch: wraps the iteration over cameras, to show progress.

    Raises:
        InputError: a picture has the wrong size.
    """
    sentences = []
    for number in watch(range(len(session.views))):
        view = session.views[number]
        repeated, moves = _looked_at(session, view, frames)
        owner = f"camera '{view.camera.name}'"
        if repeated:
            problem = f"{named(repeated)} repeat{'s' if len(repeated) == 1 else ''} the picture of the frame before"
            sentences.append(
                f"{owner}: {problem}: image motion sees none there; drop repeated frames from the video, and correct fps in session.toml."
            )
        if view.path is None and moves > STILL_PX:
            problem = f"its background moves by {moves:.1f} px per frame, and the session has no path of this camera"
            sentences.append(f"{owner}: {problem}: image motion takes it for motion of the person; give the camera its `path` in session.toml.")
    return sentences


def _looked_at(session: Session, view: View, frames: int) -> tuple[list[int], float]:
    """Return the frames that repeat the one before, and by how many pixels the background moves in the median pair."""
    tried = {round(place) for place in np.linspace(1, frames - 1, PAIRS)} if frames > 1 else set()
    repeated, shifts, previous_picture = [], [], None
    for frame in range(frames):
        picture = read_greys(session, frame, view)
        if picture is not None and previous_picture is not None:
            if _repeats(picture, previous_picture):
                repeated.append(session.frame_number(frame))
            elif frame in tried:
                shifts.append(_shift_px(previous_picture, picture))
        previous_picture = picture
    finite_shifts = [shift for shift in shifts if np.isfinite(shift)]
    return repeated, float(np.median(finite_shifts)) if finite_shifts else 0.0


def _repeats(picture: Greys, previous_picture: Greys) -> bool:
    return float(np.mean(cv2.absdiff(picture, previous_picture) > REPEATED_LEVELS)) < REPEATED_SHARE


def _shift_px(previous_picture: Greys, picture: Greys) -> float:
    """Return by how far most corners of the picture moved; the person has fewer of them than the background. NaN: too few corners."""
    start, end = corner_ways(previous_picture, picture)
    return float(np.linalg.norm(np.median(end - start, axis=0))) if len(start) else float("nan")
