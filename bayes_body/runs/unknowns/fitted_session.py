"""The session with what was inferred, and how uncertain that is: lengths, keypoint offsets, cameras and their delays.

Its means are those of the posterior, and so are its standard deviations, one for each number: what two numbers have in common is lost, but for the
scale of all lengths.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bayes_body.model.definition import Definition
from bayes_body.model.unknowns.lengths import OVERALL
from bayes_body.recording.session.session import CameraSpec, Session, Subject, View
from bayes_body.runs.unknowns.definition import DELAYS
from bayes_body.runs.unknowns.posterior import LENGTHS, Posterior

CAMERAS, OFFSETS = "cameras", "keypoint_offsets"
# Entries of a camera's motion; behind them there may be its focal length, and two of its principal point.
MOTION = 6


def fitted_session(session: Session, folder: Path, definition: Definition, posteriors: Mapping[str, Posterior]) -> Session:
    """Return a session in another folder, with posterior means and standard deviations. It uses the same pictures and keypoints.

    Args:
        session: the recording.
        folder: of the new session.
        definition: the model, whose body the lengths belong to.
        posteriors: from `posteriors_of`.
    """
    subject, views = session.subject, session.views
    if LENGTHS in posteriors or OFFSETS in posteriors:
        # Measures of another body do not apply here, but a height applies to every body.
        measured = subject if definition.takes_measures_of(subject.body) else Subject(height_m=subject.height_m)
        subject = replace(measured, body=definition.body_name)
    if LENGTHS in posteriors:
        lengths = posteriors[LENGTHS]
        relative = dict(zip(lengths.labels, (lengths.sd / lengths.mean).tolist(), strict=True))
        means_m = dict(zip(lengths.labels, lengths.mean.tolist(), strict=True))
        subject = replace(subject, lengths_m=means_m, lengths_sd={OVERALL: lengths.common, **relative})
    if OFFSETS in posteriors:
        mean_m, sd_m = (_by_marker(posteriors[OFFSETS].labels, values) for values in (posteriors[OFFSETS].mean, posteriors[OFFSETS].sd))
        subject = replace(subject, keypoint_offsets_m=mean_m, keypoint_offsets_sd_m=sd_m)
    if CAMERAS in posteriors:
        means, sds = (values.reshape(len(views), -1) for values in (posteriors[CAMERAS].mean, posteriors[CAMERAS].sd))
        views = tuple(_moved(view, mean, sd) for view, mean, sd in zip(views, means, sds, strict=True))
    if DELAYS in posteriors:
        views = (views[0], *(_late(view, *moments) for view, *moments in zip(views[1:], posteriors[DELAYS].mean, posteriors[DELAYS].sd, strict=True)))
    views = tuple(_seen_from_anywhere(view, session.folder.resolve()) for view in views)
    truth, calibration = (None if path is None else str(session.folder.resolve() / path) for path in (session.truth, session.calibration))
    fit_lengths = session.fit_lengths and LENGTHS not in posteriors
    return replace(session, folder=folder, subject=subject, views=views, truth=truth, calibration=calibration, fit_lengths=fit_lengths)


def _by_marker(labels: Sequence[str], values: Float[np.ndarray, " entry"]) -> dict[str, tuple[float, float, float]]:
    """Return x, y and z of each marker; 0 along an axis that has no entry."""
    numbers = dict(zip(labels, values.tolist(), strict=True))
    markers = dict.fromkeys(label[: -len("_x")] for label in labels)
    return {marker: (numbers.get(f"{marker}_x", 0.0), numbers.get(f"{marker}_y", 0.0), numbers.get(f"{marker}_z", 0.0)) for marker in markers}


def _moved(view: View, mean: Float[np.ndarray, " entry"], sd: Float[np.ndarray, " entry"]) -> View:
    lens = sd[MOTION:].tolist()
    uncertainty = replace(view.uncertainty, turn_sd=tuple(sd[:3].tolist()), move_sd_m=tuple(sd[3:MOTION].tolist()))
    if len(lens) in (1, 3):
        uncertainty = replace(uncertainty, focal_sd=lens[0])
    if len(lens) > 1:
        uncertainty = replace(uncertainty, centre_sd_px=(lens[-2], lens[-1]))
    return replace(view, camera=moved_spec(view.camera, mean), uncertainty=uncertainty)


def _late(view: View, delay_s: float, sd_s: float) -> View:
    return replace(view, uncertainty=replace(view.uncertainty, delay_s=float(delay_s), delay_sd_s=float(sd_s)))


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
