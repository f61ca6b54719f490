"""The report of a fitted first pose: residuals by name, outliers, and sentences for the user."""

from collections.abc import Mapping
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Array, Float

from bayes_body.initial.fitting.measurements import Measurements
from bayes_body.initial.fitting.misfit import Distances
from bayes_body.initial.fitting.points import FACE, Points
from bayes_body.recording.session.session import Session

# In units of the larger of a point's standard deviation and the robust spread of its camera: a point with a larger residual is an outlier.
OUTLIER = 4.0
# In units of a point's standard deviation: if the median residual of a camera is larger, the camera as a whole does not fit.
BAD = 3.0
# Factor from the median absolute value of a normal variable to its standard deviation.
NORMAL = 1.4826

# Where a first pose comes from: angles of the session, a fit to its markers, keypoints or silhouettes, a search in the pictures, or a run's file.
type Source = Literal["given", "fitted", "searched", "stored"]


class FirstPose(NamedTuple):
    """A session's first pose and its residuals to the session's markers and keypoints.

    Attributes:
        pose: radians and metres, in the order of the body's dofs.
        source: where it comes from.
        marker_residuals_m: by name, metres.
        keypoint_residuals_px: by camera and name, pixels; keypoints with confidence 0 are left out.
        median_m: median of the markers' residuals; NaN without markers.
        median_px: median of the keypoints' residuals, without the face; NaN without keypoints.
        outliers: (camera, name) of the points that were treated as wrong; the camera is None for a marker.
        lengths_m: the body's lengths if they were fitted, else empty.
        outline_radii_m: the (base, tip) outline radii of its parts if they were fitted, else empty.
        remarks: sentences for the user.
        draws: equally likely poses, if the pose was found in pictures; else None.
    """

    pose: Float[Array, " dof"]
    source: Source
    marker_residuals_m: Mapping[str, float] = {}
    keypoint_residuals_px: Mapping[str, Mapping[str, float]] = {}
    median_m: float = float("nan")
    median_px: float = float("nan")
    outliers: tuple[tuple[str | None, str], ...] = ()
    lengths_m: Mapping[str, float] = {}
    outline_radii_m: Mapping[str, tuple[float, float]] = {}
    remarks: tuple[str, ...] = ()
    draws: Float[Array, "draw dof"] | None = None


class _Row(NamedTuple):
    """One marker or keypoint: its residual and standard deviation, metres for a marker (camera None), pixels for a keypoint."""

    camera: str | None
    name: str
    residual: float
    sd: float


def tell(
    session: Session, points: Points, measurements: Measurements, missed: Distances, pose: Float[Array, " dof"], lengths: Mapping[str, float]
) -> FirstPose:
    """Return the report of a fit, with remarks on points that were treated as wrong, and on markers or a camera that fit badly as a whole."""
    markers, cameras = _marker_rows(points, measurements, missed), _keypoint_rows(session, points, measurements, missed)
    groups = [markers, *cameras.values()]
    return FirstPose(
        pose=pose,
        source="fitted",
        marker_residuals_m={row.name: row.residual for row in markers},
        keypoint_residuals_px={camera: {row.name: row.residual for row in rows} for camera, rows in cameras.items()},
        median_m=_median([row.residual for row in _bones(markers)]),
        median_px=_median([row.residual for rows in cameras.values() for row in _bones(rows)]),
        outliers=tuple((row.camera, row.name) for rows in groups for row in _outliers(rows)),
        lengths_m=lengths,
        remarks=tuple(remark for rows in groups for remark in _remarks(rows)),
    )


def _marker_rows(points: Points, measurements: Measurements, missed: Distances) -> list[_Row]:
    metres, sd = np.asarray(missed.metres), np.asarray(missed.metres_sd)
    return [_Row(None, points.names[k], float(metres[k]), float(sd[k])) for k in np.flatnonzero(measurements.marker_weights)]


def _keypoint_rows(session: Session, points: Points, measurements: Measurements, missed: Distances) -> dict[str, list[_Row]]:
    pixels, sd = np.asarray(missed.pixels), np.asarray(missed.pixels_sd)
    return {
        view.camera.name: [
            _Row(view.camera.name, points.names[k], float(pixels[c, k]), float(sd[c, k])) for k in np.flatnonzero(measurements.pixel_weights[c])
        ]
        for c, view in enumerate(session.views)
        if view.camera.name in session.initial_keypoints
    }


def _bones(rows: list[_Row]) -> list[_Row]:
    return [row for row in rows if row.name not in FACE]


def _outliers(rows: list[_Row]) -> list[_Row]:
    spread = NORMAL * _median([row.residual for row in rows])
    return [row for row in rows if row.residual > OUTLIER * max(row.sd, spread)]


def _remarks(rows: list[_Row]) -> list[str]:
    if _median([row.residual / row.sd for row in _bones(rows)]) > BAD:
        whose = "the markers" if rows[0].camera is None else f"camera {rows[0].camera}'s keypoints"
        median = _amount(rows[0].camera, _median([row.residual for row in _bones(rows)]))
        check = "check the calibration, the subject's height, and that all show the same person at the same time"
        return [f"{whose} fit badly, median {median} off: {check}"]
    outliers = _outliers(rows)
    return [_describe_outliers(outliers)] if outliers else []


def _describe_outliers(rows: list[_Row]) -> str:
    """One sentence for all wrong points of a camera, or for all wrong markers."""
    camera, is_one = rows[0].camera, len(rows) == 1
    points = ", ".join(f"{row.name} is {_amount(camera, row.residual)}" for row in rows) + " off"
    if camera is None:
        return f"marker{'' if is_one else 's'} {points}: treated as wrong"
    return f"camera {camera}'s {points}: treated as {'a wrong detection' if is_one else 'wrong detections'}"


def _amount(camera: str | None, residual: float) -> str:
    return f"{1000 * residual:.0f} mm" if camera is None else f"{residual:.0f} px"


def _median(values: list[float]) -> float:
    return float(np.median(values)) if values else float("nan")
