"""The session with what was inferred: the subject's lengths, and the cameras where they are."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bayes_body.model.definition import Definition
from bayes_body.recording.session.session import CameraSpec, Session, Subject, View
from bayes_body.runs.unknowns.posterior import LENGTHS, Posterior

CAMERAS = "cameras"
# Entries of a camera's motion; behind them there may be its focal length, and two of its principal point.
MOTION = 6


def fitted_session(session: Session, folder: Path, definition: Definition, posteriors: Mapping[str, Posterior]) -> Session:
    """Return a session in another folder, with the posterior means of lengths and cameras. It uses the same pictures and keypoints.

    Args:
        session: the recording.
        folder: of the new session.
        definition: the model, whose body the lengths belong to.
        posteriors: from `posteriors_of`.
    """
    subject, views = session.subject, session.views
    if LENGTHS in posteriors:
        lengths = dict(zip(posteriors[LENGTHS].labels, posteriors[LENGTHS].mean.tolist(), strict=True))
        # Measures of another body do not apply here, but a height applies to every body.
        measured = subject if definition.takes_measures_of(subject.body) else Subject(height_m=subject.height_m)
        subject = replace(measured, body=definition.body_name, lengths_m=lengths)
    if CAMERAS in posteriors:
        motions = posteriors[CAMERAS].mean.reshape(len(views), -1)
        views = tuple(replace(view, camera=moved_spec(view.camera, motion)) for view, motion in zip(views, motions, strict=True))
    views = tuple(_seen_from_anywhere(view, session.folder.resolve()) for view in views)
    truth = None if session.truth is None else str(session.folder.resolve() / session.truth)
    fit_lengths = session.fit_lengths and LENGTHS not in posteriors
    return replace(session, folder=folder, subject=subject, views=views, truth=truth, fit_lengths=fit_lengths)


def moved_spec(camera: CameraSpec, motion: Float[np.ndarray, " entry"]) -> CameraSpec:
    """Return a camera turned about its centre and moved along its axes, as `model.unknowns.cameras.moved` does.

    Args:
        camera: the camera.
        motion: turn (radians) and move (metres), then perhaps the relative change of the focal length and the shift of the principal point (pixels).
    """
    from scipy.spatial.transform import Rotation

    turn, lens = Rotation.from_rotvec(motion[:3]).as_matrix(), motion[MOTION:]
    translation = turn @ np.asarray(camera.translation_m, float) + motion[3:MOTION]
    camera = replace(camera, rotation=turn @ np.asarray(camera.rotation, float), translation_m=translation)
    if len(lens) in (1, 3):
        x, y = (float(focal * np.exp(lens[0])) for focal in camera.focal_px)
        camera = replace(camera, focal_px=(x, y))
    if len(lens) > 1:
        column, row = (float(centre + shift) for centre, shift in zip(camera.centre_px, lens[-2:], strict=True))
        camera = replace(camera, centre_px=(column, row))
    return camera


def _seen_from_anywhere(view: View, folder: Path) -> View:
    """Return a view whose paths do not start at a session's folder."""

    def path(text: str | None) -> str | None:
        return None if text is None else str(folder / text)

    def pattern(text: str | None) -> str | None:
        # A percent sign in the folder's name is not the frame's number.
        return None if text is None else str(Path(str(folder).replace("%", "%%")) / text)

    return replace(
        view,
        images=pattern(view.images),
        masks=pattern(view.masks),
        video=path(view.video),
        background=path(view.background),
        keypoints=path(view.keypoints),
        path=path(view.path),
    )
