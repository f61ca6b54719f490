"""Whether a frame shows somebody, as the detectors tell, and which frame does where the first one does not."""

from bayes_body.base.errors import InputError
from bayes_body.initial.detection.detect import TRUSTED, detect
from bayes_body.recording.observation.silhouettes import has_silhouettes
from bayes_body.recording.session.session import Session

# The part that says where a person is.
TRUNK = "torso"
# Where the first frame shows nobody, so many other frames are looked at, so many seconds apart.
LOOKED_AT, LOOK_S = 20, 1.0


def shows_somebody(session: Session, frame: int) -> bool:
    """Return whether detectors find a person in a frame, counted from 0.

    Raises:
        InputError: a file of the session cannot be used.
    """
    return TRUNK in detect(session, frame, TRUSTED).parts


def later_frame(session: Session) -> int | None:
    """Return the first frame after frame 0 that shows a person, counted from 0; None if none of those that are looked at does.

    Raises:
        InputError: a file of the session cannot be used.
    """
    step = max(1, round(LOOK_S * session.fps))
    looked_at = range(step, min(session.frames, step * LOOKED_AT + 1), step)
    return next((frame for frame in looked_at if shows_somebody(session, frame)), None)


def nobody_first(session: Session) -> str | None:
    """Return a sentence if the session's silhouettes show nobody in frame 0; None if they show somebody, or if other data tell or nothing does."""
    pose_data = session.initial or session.initial_markers or session.initial_keypoints or any(view.keypoints for view in session.views)
    if pose_data or not has_silhouettes(session):
        return None
    first = session.first_frame
    try:
        if shows_somebody(session, 0):
            return None
        later = later_frame(session)
    except InputError as error:
        return f"It is not known whether somebody is in frame {first}: {error}"
    if later is None:
        return f"Nobody is detected in frame {first}, nor in {LOOKED_AT} s after it: check the silhouettes, or give keypoints."
    remedy = f"import again with --first-frame {session.frame_number(later)} --overwrite, or give the same option to `bayes-body track`"
    return f"Nobody is detected in frame {first}, the first one; somebody is in frame {session.frame_number(later)}: {remedy}."
