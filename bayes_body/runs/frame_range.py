"""The range of a recording's frames that a run tracks."""

from bayes_body.initial import Show
from bayes_body.recording.readers.excerpt import excerpt
from bayes_body.recording.session.session import Session


def frames_from(session: Session, first_frame: int | None, show: Show) -> Session:
    """Return the session from a frame on; a note tells the user if its first pose belongs to another frame.

    Args:
        session: the recording.
        first_frame: number of the first frame that is tracked; the session's by default.
        show: receives lines for the user.

    Raises:
        InputError: the session does not have the frame.
    """
    part = excerpt(session, first_frame)
    # Keypoints of all frames have those of the new first one too.
    has_first_pose = session.initial or session.initial_markers or (session.initial_keypoints and not any(view.keypoints for view in session.views))
    if has_first_pose and part.first_frame != session.first_frame:
        show(f"note: the first pose in session.toml belongs to frame {session.first_frame}, and is not used for frame {part.first_frame}.")
    return part


def number_of_first(session: Session, whole: Session) -> int | None:
    """Return the number of a run's first frame as `run.toml` stores it; None for the first of the session."""
    return None if session.first_frame == whole.first_frame else session.first_frame
