"""A range of a recording's frames as a session of its own."""

from dataclasses import replace

from bayes_body.base.errors import input_error
from bayes_body.recording.readers.camera_path import cameras_at
from bayes_body.recording.session.session import Session


def excerpt(session: Session, first_frame: int | None = None, frames: int | None = None) -> Session:
    """Return the session of consecutive frames. It knows the whole recording: a background is still learned from all of it.

    Args:
        session: the recording.
        first_frame: number of the first frame, as in the file names (`Session.frame_number`); the session's by default.
        frames: number of frames; by default all from the first one on.

    Returns:
        The session with those frames. If it begins later, it has no first pose: that of `session` belongs to another frame.

    Raises:
        InputError: the recording does not have these frames, or the path of a moving camera cannot be read.
    """
    end = session.first_frame + session.frames
    first = session.first_frame if first_frame is None else first_frame
    if not session.first_frame <= first < end:
        expected = f"a frame of the recording, {session.first_frame} to {end - 1}"
        raise input_error("--first-frame", str(first), expected, "give the number of one of its frames")
    count = end - first if frames is None else frames
    if not 1 <= count <= end - first:
        expected = f"a whole number from 1 to {end - first}, the frames from {first} to the recording's last, {end - 1}"
        raise input_error("--frames", str(count), expected, "give a smaller number" if count > 0 else "give a larger number")
    if (first, count) == (session.first_frame, session.frames):
        return session
    part = replace(session, first_frame=first, frames=count, recorded=session.recorded or (session.first_frame, session.frames))
    if first == session.first_frame:
        return part
    # A moving camera's own extrinsics are those of the first frame.
    views = tuple(replace(view, camera=camera) for view, camera in zip(part.views, cameras_at(part, 0), strict=True))
    positions = session.positions & frozenset(session.subject.motion_sd)
    return replace(part, views=views, initial={}, positions=positions, initial_markers={}, initial_keypoints={})
