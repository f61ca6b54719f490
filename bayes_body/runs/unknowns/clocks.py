"""Cameras that are late by whole frames are shifted before the rest of their delays is inferred, which is of the first order in time."""

from dataclasses import replace

from bayes_body.initial import Show
from bayes_body.recording.readers.agreement.cameras import camera_agreement
from bayes_body.recording.readers.excerpt import excerpt
from bayes_body.recording.session.session import Session


def with_whole_frames(session: Session, show: Show) -> Session:
    """Return the session with cameras shifted by whole frames where their keypoints clearly fit the others' better.

    It has only the frames that all cameras have. If these begin later, rows of a file of true markers would belong to other frames: it is left out.

    Args:
        session: the recording.
        show: receives a line for each shifted camera.

    Raises:
        InputError: a file of keypoints cannot be read.
    """
    clocks = {agreement.name: agreement.clock for agreement in camera_agreement(session)}
    shifts = {name: clock.frames for name, clock in clocks.items() if clock is not None and clock.frames}
    if not shifts:
        return session
    views = tuple(replace(view, offset=view.offset + shifts.get(view.camera.name, 0)) for view in session.views)
    for view in views:
        if shift := shifts.get(view.camera.name):
            show(f"clock       camera '{view.camera.name}' fits the others best {_frames(shift)}: its offset is {view.offset} in the new session")
    late, early = max(0, -min(shifts.values())), max(0, *shifts.values())
    # First keypoints belong to the frame that a camera showed before.
    shifted = replace(session, views=views, initial_keypoints={})
    part = excerpt(shifted, session.first_frame + late, session.frames - late - early)
    recorded = None if session.recorded is None else (session.recorded[0] + late, session.recorded[1] - late - early)
    return replace(part, recorded=recorded, truth=None if late else session.truth)


def _frames(shift: int) -> str:
    return f"{abs(shift)} frame{'s' * (abs(shift) > 1)} {'later' if shift > 0 else 'earlier'}"
