"""The data of frames, read ahead of the filter that needs them: forwards, or backwards for a smoother.

One thread reads frame after frame, all cameras at once. Others compute the silhouettes and maps of several frames at once, and send them to the
device.
"""

from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from bayes_body.kernels.batching import everywhere
from bayes_body.model.build import Model
from bayes_body.recording.observation.frames import Frame, cameras_with_picture, frame_of_keypoints, read_frame
from bayes_body.recording.observation.prefetch import prefetch, threads_for_work
from bayes_body.recording.session.session import Keypoints, Session
from bayes_body.tracking.proposing import Proposed, Proposer

# Number of frames that are read forwards and then yielded backwards: a video cannot be read backwards.
PIECE = 8


class Observed(NamedTuple):
    """A frame's data.

    Attributes:
        seen: which cameras saw it.
        data: the factors' arrays.
        factors: the factors themselves if a camera moves; None: those of the model.
        proposals: where to look for the parts of the body; none without a proposer.
    """

    seen: np.ndarray
    data: Any
    factors: Any
    proposals: Proposed = ()


def observations(session: Session, model: Model, frames: range, proposer: Proposer | None = None) -> Generator[Observed]:
    """Yield the data of each frame; background threads prepare the next ones.

    For a model that reads no pictures, none is decoded: a camera sees a frame if its file exists or its video is long enough. A picture that is
    damaged or shows nothing makes no difference to such a model, whose keypoints are those of the session. `proposer` detects in each frame where to
    look for the parts of the body.

    Raises:
        InputError: a frame cannot be read.
    """

    def visibility(index: int) -> Sequence[bool] | None:
        return None if model.reads_pictures else cameras_with_picture(session, index)

    return prefetch(_read(session, model, ([index] for index in frames), visibility), lambda frame: _observed(session, model, frame, proposer))


def observations_backwards(session: Session, model: Model, last: int, visibility: Callable[[int], Sequence[bool]]) -> Generator[Observed]:
    """Yield the data of each frame from `last` to the first, as `observations` does. `visibility` says which cameras have an image of a frame."""
    pieces = (range(max(stop - PIECE, 0), stop) for stop in range(last + 1, 0, -PIECE))
    return prefetch(_read(session, model, pieces, visibility), lambda frame: _observed(session, model, frame))


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


def _read(session: Session, model: Model, pieces: Iterable[Sequence[int]], visibility: Callable[[int], Sequence[bool] | None]) -> Generator[Frame]:
    """Yield the frames of each piece, which is read forwards, from its last to its first."""
    with ThreadPoolExecutor(min(threads_for_work(), len(session.views)), thread_name_prefix="prefetch-video") as threads:
        at_once = threads if model.reads_pictures else None
        for piece in pieces:
            frames = [read_frame(session, index, model.reads_before, visibility(index), at_once) for index in piece]
            while frames:
                yield frames.pop()


def _observed(session: Session, model: Model, frame: Frame, proposer: Proposer | None = None) -> Observed:
    factors = everywhere(model.at(frame.cameras).factors) if session.moves else None
    proposals = () if proposer is None else everywhere(proposer(frame))
    return Observed(np.array(frame.seen), everywhere(model.observe(frame)), factors, proposals)
