"""The data of frames, read ahead of the filter that needs them: forwards, or backwards for a smoother."""

from collections.abc import Callable, Generator, Sequence
from typing import Any, NamedTuple

import numpy as np

from bayes_body.kernels.batching import everywhere
from bayes_body.model.build import Model
from bayes_body.recording.observation.frames import cameras_with_picture, frame_of_keypoints, prefetch, read_frame
from bayes_body.recording.session.session import Keypoints, Session

# Number of frames that are read forwards and then yielded backwards: a video cannot be read backwards.
PIECE = 8


class Observed(NamedTuple):
    """A frame's data: which cameras saw it, the factors' arrays, and the factors themselves if a camera moves (None: those of the model)."""

    seen: np.ndarray
    data: Any
    factors: Any


def observations(session: Session, model: Model, frames: range) -> Generator[Observed]:
    """Yield the data of each frame; a background thread reads the next one.

    For a model that reads no pictures, none is decoded: a camera sees a frame if its file exists or its video is long enough. A picture that is
    damaged or shows nothing makes no difference to such a model, whose keypoints are those of the session.

    Raises:
        InputError: a frame cannot be read.
    """
    return prefetch(frames, lambda index: _observe(session, model, index))


def observations_backwards(session: Session, model: Model, last: int, visibility: Callable[[int], Sequence[bool]]) -> Generator[Observed]:
    """Yield the data of each frame from `last` to the first, as `observations` does. `visibility` says which cameras have an image of a frame."""
    pieces = [range(max(stop - PIECE, 0), stop) for stop in range(last + 1, 0, -PIECE)]
    for piece in prefetch(pieces, lambda some: [_observe(session, model, index, visibility(index)) for index in some]):
        yield from reversed(piece)


def observe_keypoints(session: Session, model: Model, index: int, keypoints: tuple[Keypoints | None, ...]) -> Observed:
    """Return the data of a frame of still cameras for a model that reads only keypoints.

    Args:
        session: the recording; it need not have the frame yet.
        model: the model.
        index: the frame's number, counted from 0.
        keypoints: of each camera; None for one that did not see the frame.
    """
    frame = frame_of_keypoints(session, index, keypoints)
    return Observed(np.array(frame.seen), everywhere(model.observe(frame)), None)


def _observe(session: Session, model: Model, index: int, visibility: Sequence[bool] | None = None) -> Observed:
    if visibility is None and not model.reads_pictures:
        visibility = cameras_with_picture(session, index)
    frame = read_frame(session, index, model.reads_before, visibility)
    factors = everywhere(model.at(frame.cameras).factors) if session.moves else None
    return Observed(np.array(frame.seen), everywhere(model.observe(frame)), factors)
