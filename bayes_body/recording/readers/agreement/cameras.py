r"""How well calibrated cameras agree on the subject's keypoints, and whose clock is off.

Points are triangulated from all cameras. In a camera's image, a point from the *other* cameras says more about this camera than one that it helped to
place. With the rows $A_i$, $b_i$ of camera i's rays (triangulate.py, divided by the depth), the point without camera c solves
$\sum_{i \ne c} A_i^T A_i\, X = \sum_{i \ne c} A_i^T b_i$. All such points follow from one triangulation.

For the clock of camera c, its keypoints in frame t + k are compared with the others' points of frame t, k = -6 to 6. A wrong calibration moves the
residuals of a keypoint all alike. A wrong clock moves them with the speed of the keypoint. Hence the median residual of each keypoint is subtracted:
what remains is the scatter, and a delay is claimed only if it falls clearly. A camera with a wrong clock also spoils the points of the others. Hence
the camera whose scatter falls most is shifted first, and all are compared again.

With two cameras there is no point without one of them. The scatter is then that of the residuals of both, which do not see a motion in the plane
through the point and both cameras: small delays go unnoticed.
"""

import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.lib.stride_tricks import sliding_window_view

from bayes_body.recording.readers.keypoints.series import read_series
from bayes_body.recording.readers.keypoints.triangulate import NEAR_M, Triangulated, project, reprojection_errors, triangulate, undistorted_rays
from bayes_body.recording.session.session import CameraSpec, Session

# As in the definition `keypoints`: a keypoint with less counts as not found.
LEAST_CONFIDENCE = 0.3
# Frames times keypoints times pairs of cameras that are triangulated: about a third of a second.
MOST_PAIRS, FEWEST_FRAMES = 30_000, 50
# A median of fewer distances says little.
FEWEST_DISTANCES = 100
# Running median of each keypoint over so many frames, for the clocks only: it commutes with a shift, and most of the network's noise is gone.
SMOOTHED_FRAMES = 5
# Frames; a minimum of the scatter at the end of the range is none.
FARTHEST_SHIFT = 6
# By how much the scatter must fall: relative, and as a fraction of the image's diagonal (1 px in 1080 x 1920).
LEAST_FALL, LEAST_FALL_OF_DIAGONAL = 0.1, 4.5e-4
# The rays of a point are all but parallel.
WORST_CONDITION = 1e8
SHIFTS = np.arange(-FARTHEST_SHIFT, FARTHEST_SHIFT + 1)


class Clock(NamedTuple):
    """A delay of a camera: frame k + `frames` of it shows what frame k of the others shows.

    Attributes:
        frames: whole frames; 0 if no delay is clear.
        interpolated: the same between frames, where a parabola through the scatter has its minimum; NaN if the minimum is not enclosed.
        scatter_px: median scatter without the shift, pixels.
        shifted_px: the same with it.
    """

    frames: int
    interpolated: float
    scatter_px: float
    shifted_px: float


class CameraAgreement(NamedTuple):
    """How well a camera agrees with the others; medians over frames and keypoints.

    Attributes:
        name: the camera's.
        diagonal_px: of its images, pixels.
        error_px: reprojection error of points from all cameras, pixels.
        left_out_px: distance of its keypoints from points of the other cameras, pixels; NaN with two cameras.
        left_out_m: the same at the person's distance, metres.
        clock: its delay; None if there are too few frames to say.
    """

    name: str
    diagonal_px: float
    error_px: float
    left_out_px: float
    left_out_m: float
    clock: Clock | None


class _Sample(NamedTuple):
    """Some frames of a recording.

    Attributes:
        cameras: those that have keypoints.
        keypoints: column, row, confidence in all frames; NaN where not found.
        smoothed: column, row after the running median.
        frames: indices of the frames that are triangulated.
        points: their points.
    """

    cameras: Sequence[CameraSpec]
    keypoints: Float[np.ndarray, "camera frame keypoint 3"]
    smoothed: Float[np.ndarray, "camera frame keypoint 2"]
    frames: Int[np.ndarray, " chosen"]
    points: Triangulated


def camera_agreement(session: Session) -> list[CameraAgreement]:
    """Compare the cameras that have keypoints; empty with fewer than two, with moving cameras, or if too few keypoints agree.

    Raises:
        InputError: a file of keypoints cannot be read.
    """
    cameras, _, keypoints = common_keypoints(session)
    return [] if session.moves or len(cameras) < 2 else compare_cameras(cameras, keypoints)


def common_keypoints(session: Session) -> tuple[list[CameraSpec], list[str], Float[np.ndarray, "camera frame keypoint 3"]]:
    """Return the cameras with keypoints, the names that all of these have, and their keypoints in all frames; NaN where not found.

    Raises:
        InputError: a file of keypoints cannot be read.
    """
    files = [(view, read_series(path)) for view in session.views if (path := session.keypoints_path(view)) is not None]
    names = [name for name in files[0][1].names if all(name in series.names for _, series in files)] if files else []
    keypoints = np.full((len(files), session.frames, len(names), 3), np.nan)
    for c, (view, series) in enumerate(files):
        rows = np.arange(session.frames) + session.number(view, 0) - series.first
        inside = (rows >= 0) & (rows < len(series.keypoints))
        keypoints[c, inside] = series.keypoints[rows[inside]][:, [series.names.index(name) for name in names]]
    keypoints[~(np.isfinite(keypoints).all(axis=-1) & (keypoints[..., 2] >= LEAST_CONFIDENCE))] = np.nan
    return [view.camera for view, _ in files], names, keypoints


def compare_cameras(cameras: Sequence[CameraSpec], keypoints: Float[np.ndarray, "camera frame keypoint 3"]) -> list[CameraAgreement]:
    """Compare cameras by what they see at the same time; empty if too few keypoints agree.

    Args:
        cameras: at least two, which do not move.
        keypoints: column, row (pixels; NaN where not found) and confidence, as from `common_keypoints`.
    """
    if not keypoints.size:
        return []
    sample = _sample(cameras, keypoints)
    if sample.points.used.sum(axis=1).min() < FEWEST_DISTANCES:
        return []
    errors = reprojection_errors(cameras, sample.points.points_m, _flat(sample.keypoints[:, sample.frames]))
    clocks = _clocks(sample)
    offsets = np.array([clock.frames if clock else 0 for clock in clocks])
    agreements = []
    for c, (camera, clock) in enumerate(zip(cameras, clocks, strict=True)):
        left_out_px = np.nan
        if len(cameras) > 2:
            left_out_px = _median_length(_pixels(sample, c, int(offsets[c])) - _predicted(sample, offsets, c))
        depth_m = float(_median(sample.points.points_m @ camera.rotation[2])) + camera.translation_m[2]
        left_out_m = left_out_px * depth_m / max(camera.focal_px)
        agreements.append(CameraAgreement(camera.name, _diagonal(camera), float(_median(errors[c])), left_out_px, left_out_m, clock))
    return agreements


def _sample(cameras: Sequence[CameraSpec], keypoints: Float[np.ndarray, "camera frame keypoint 3"]) -> _Sample:
    chosen = spread_frames(keypoints, FARTHEST_SHIFT if _has_clocks(keypoints.shape[1]) else 0)
    return _Sample(cameras, keypoints, _smoothed(keypoints[..., :2]), chosen, triangulate(cameras, _flat(keypoints[:, chosen])))


def spread_frames(keypoints: Float[np.ndarray, "camera frame keypoint 3"], margin: int) -> Int[np.ndarray, " chosen"]:
    """Choose evenly spaced frames, so few that they are triangulated in a third of a second; none of the first and last `margin` frames."""
    cameras, frames, names = keypoints.shape[:3]
    count = max(FEWEST_FRAMES, MOST_PAIRS // (cameras * (cameras - 1) // 2 * names))
    return np.unique(np.linspace(margin, frames - 1 - margin, min(count, frames)).round().astype(int))


def _has_clocks(frames: int) -> bool:
    return frames >= FEWEST_FRAMES + 2 * FARTHEST_SHIFT


def _smoothed(pixels: Float[np.ndarray, "camera frame keypoint 2"]) -> Float[np.ndarray, "camera frame keypoint 2"]:
    half = SMOOTHED_FRAMES // 2
    padded = np.pad(pixels, ((0, 0), (half, half), (0, 0), (0, 0)), constant_values=np.nan)
    return np.where(np.isnan(pixels), np.nan, _median(sliding_window_view(padded, SMOOTHED_FRAMES, axis=1), axis=-1))


def _clocks(sample: _Sample) -> Sequence[Clock | None]:
    """Shift the camera whose scatter falls most, and repeat until no scatter falls clearly."""
    count = len(sample.cameras)
    if not _has_clocks(sample.keypoints.shape[1]):
        return [None] * count
    offsets = np.zeros(count, int)
    for _ in range(count):
        # The first of two cameras is the clock of the other.
        curves = {c: _scatters(sample, offsets, c) for c in (range(count) if count > 2 else (1,))}
        falls = {c: _clear_fall(curve, _diagonal(sample.cameras[c])) for c, curve in curves.items()}
        worst = max(falls, key=lambda c: falls[c])
        if falls[worst] == 0:
            break
        offsets[worst] += SHIFTS[np.argmin(curves[worst])]
        if abs(offsets[worst]) >= FARTHEST_SHIFT or offsets.all():
            # Cameras that do not fit, such as wrongly calibrated ones, run away.
            offsets[:] = 0
            break
    return [_clock(sample, offsets, c) for c in range(count)]


def _clear_fall(curve: Float[np.ndarray, " shift"], diagonal_px: float) -> float:
    """How far the scatter falls by a shift, relative; 0 if that is not clear."""
    scatter = curve[FARTHEST_SHIFT]
    fall = scatter - curve.min()
    return float(fall / scatter) if fall > max(LEAST_FALL * scatter, LEAST_FALL_OF_DIAGONAL * diagonal_px) else 0.0


def _clock(sample: _Sample, offsets: Int[np.ndarray, " camera"], camera: int) -> Clock:
    """The clock of one camera, while the others have their offsets."""
    curve = _scatters(sample, np.where(np.arange(len(offsets)) == camera, 0, offsets), camera)
    # The others were shifted after it, perhaps: its own best shift may be another frame by now.
    frames = int(SHIFTS[np.argmin(curve)]) if offsets[camera] else 0
    k = frames + FARTHEST_SHIFT
    interpolated = np.nan
    if 0 < k < len(curve) - 1:
        # The scatter is the root of a sum of squares: its square is the parabola.
        preceding, lowest, subsequent = curve[k - 1 : k + 2] ** 2
        bend = preceding - 2 * lowest + subsequent
        interpolated = frames + (preceding - subsequent) / (2 * bend) if bend > 0 else np.nan
    return Clock(frames, float(interpolated), float(curve[FARTHEST_SHIFT]), float(curve[k]))


def _scatters(sample: _Sample, offsets: Int[np.ndarray, " camera"], camera: int) -> Float[np.ndarray, " shift"]:
    """Median scatter of a camera's residuals for each further shift of it, pixels; infinite if unknown."""
    scatters, predicted = [], None
    for shift in SHIFTS:
        shifted = offsets + shift * (np.arange(len(offsets)) == camera)
        if predicted is None or len(sample.cameras) == 2:
            predicted = _predicted(sample, shifted, camera)
        residuals = (_pixels(sample, camera, int(shifted[camera])) - predicted).reshape(len(sample.frames), -1, 2)
        scatter = _median_length(residuals - _median(residuals, axis=0))
        scatters.append(scatter if np.isfinite(scatter) else np.inf)
    return np.array(scatters)


def _pixels(sample: _Sample, camera: int, offset: int) -> Float[np.ndarray, "point 2"]:
    """The smoothed keypoints of a camera that is shifted; NaN outside of the recording."""
    rows, frames = sample.frames + offset, sample.smoothed.shape[1]
    pixels = sample.smoothed[camera, np.clip(rows, 0, frames - 1)]
    return np.where(((rows >= 0) & (rows < frames))[:, None, None], pixels, np.nan).reshape(-1, 2)


def _predicted(sample: _Sample, offsets: Int[np.ndarray, " camera"], camera: int) -> Float[np.ndarray, "point 2"]:
    """Where a camera should see the points of the other cameras, pixels; of two cameras, those of both. NaN where fewer than two see a point."""
    placing = [c for c in range(len(sample.cameras)) if c != camera or len(sample.cameras) == 2]
    count, points_m = sample.points.used.shape[1], np.nan_to_num(sample.points.points_m)
    normal, right, seeing = np.zeros((count, 3, 3)), np.zeros((count, 3)), np.zeros(count, int)
    for c in placing:
        spec, pixels = sample.cameras[c], _pixels(sample, c, int(offsets[c]))
        is_used = sample.points.used[c] & np.isfinite(pixels).all(axis=-1)
        depth = points_m @ spec.rotation[2] + spec.translation_m[2]
        weights = np.where(is_used, 1 / np.maximum(np.abs(depth), NEAR_M), 0.0)[:, None]
        rays = np.nan_to_num(undistorted_rays(spec, pixels))
        A = weights[..., None] * (rays[..., None] * spec.rotation[2] - spec.rotation[:2])
        b = weights * (spec.translation_m[:2] - rays * spec.translation_m[2])
        normal += A.transpose(0, 2, 1) @ A
        right += (A.transpose(0, 2, 1) @ b[..., None])[..., 0]
        seeing += is_used
    points = np.full((count, 3), np.nan)
    solvable = (seeing >= 2) & (np.linalg.cond(normal) < WORST_CONDITION)
    points[solvable] = np.linalg.solve(normal[solvable], right[solvable][..., None])[..., 0]
    pixels = project(sample.cameras[camera], points)
    return np.where(np.isfinite(pixels), pixels, np.nan)


def _flat(frames: Float[np.ndarray, "camera frame keypoint entry"]) -> Float[np.ndarray, "camera point entry"]:
    return frames.reshape(len(frames), -1, frames.shape[-1])


def _diagonal(camera: CameraSpec) -> float:
    return float(np.hypot(*camera.size_px))


def _median_length(vectors: Float[np.ndarray, "*_ 2"]) -> float:
    return float(_median(np.linalg.norm(vectors, axis=-1)))


def _median(values: Float[np.ndarray, "..."], axis: int | None = None) -> Any:
    """Median of what is known; NaN without a word where nothing is."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.nanmedian(values, axis=axis)
