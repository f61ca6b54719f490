"""The frames from which unknowns are inferred: those of the recording's best stretch, at a rate at which a few of them show much movement.

A recording of a lower rate has fewer frames for the same time, and the motion prior knows its rate. So frames between those that are used may be left
out without an error, which skipping single frames would make.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bayes_body.base.errors import input_error
from bayes_body.recording.readers.keypoints.series import read_series
from bayes_body.recording.session.session import Session

# Keypoints with lower confidence count as not found.
LEAST_CONFIDENCE = 0.3
# Frames per second that are enough to follow a person. Errors of a network last for some time: frames further apart tell more.
RATE = 20.0
# Joints that two cameras must see in the first frame, so that a first pose can be fitted.
FEWEST = 4


class Stretch(NamedTuple):
    """Frames of a session: so many of them, every `step`-th from `first` on, counted from 0."""

    first: int
    frames: int
    step: int

    @property
    def span(self) -> int:
        """Number of frames from the first to the last."""
        return (self.frames - 1) * self.step + 1

    @property
    def indices(self) -> range:
        """The frames, counted from the stretch's first one."""
        return range(0, self.span, self.step)


def keypoints_of(session: Session, names: tuple[str, ...]) -> Float[np.ndarray, "frame camera marker 2"]:
    """Return the keypoints of a session's frames, pixels; NaN where they are not found.

    Args:
        session: the recording.
        names: of the markers.

    Raises:
        InputError: a file cannot be read.
    """
    pixels = np.full((session.frames, len(session.views), len(names), 2), np.nan)
    for camera, view in enumerate(session.views):
        path = session.keypoints_path(view)
        series = None if path is None else read_series(path)
        for frame in range(session.frames if series else 0):
            points = series.frame(session.number(view, frame)) if series else {}
            for marker, name in enumerate(names):
                if name in points and points[name][2] >= LEAST_CONFIDENCE:
                    pixels[frame, camera, marker] = points[name][:2]
    return pixels


def check_cameras(session: Session) -> None:
    """Check that cameras can be inferred.

    Raises:
        InputError: fewer than two cameras have keypoints, or one moves.
    """
    with_keypoints = sum(view.keypoints is not None for view in session.views)
    if with_keypoints < 2:
        problem = f"{with_keypoints or 'no'} camera{'' if with_keypoints == 1 else 's'} with keypoints"
        expected = "two or more: one camera cannot tell a small person from a distant one"
        raise input_error(session.folder / "session.toml", problem, expected, "import the recording with --keypoints")
    for view in session.views:
        if view.path is not None:
            expected = "cameras that stand still: one correction holds for all frames"
            raise input_error(f"camera '{view.camera.name}'", "it moves", expected, "leave it out of the session")


def best_stretch(session: Session, names: tuple[str, ...], count: int) -> Stretch:
    """Return the frames in which two cameras or more see the most joints together.

    Args:
        session: the recording.
        names: of the body's markers.
        count: number of frames; fewer if the recording has fewer.

    Raises:
        InputError: no frame shows enough.
    """
    visible: Int[np.ndarray, " frame"] = (np.isfinite(keypoints_of(session, names)[..., 0]).sum(axis=1) >= 2).sum(axis=1)
    count = min(count, session.frames)
    widest = (session.frames - 1) // max(count - 1, 1)
    stretch = Stretch(0, count, max(1, min(round(session.fps / RATE), widest)))
    windows = np.lib.stride_tricks.sliding_window_view(visible, stretch.span)[:, :: stretch.step]
    score = np.where(windows[:, 0] >= FEWEST, windows.sum(axis=1), -1)
    if score.max() < 0:
        problem = f"no frame in which two cameras see the same {FEWEST} joints"
        raise input_error(session.folder / "session.toml", problem, "keypoints of one person in two cameras", "check the import's picture")
    return stretch._replace(first=int(score.argmax()))
