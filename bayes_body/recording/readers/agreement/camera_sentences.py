"""Sentences about cameras that do not fit the others (cameras.py)."""

from collections.abc import Mapping, Sequence

import numpy as np

from bayes_body.recording.readers.agreement.cameras import CameraAgreement

# How much farther a camera's keypoints may be from the others' points than theirs are: in pixels, and at the person's distance.
WORSE = 1.5
# An error up to this fraction of the diagonal is that of a good network, whichever camera has it.
UNSUSPECTED = 0.0035
# The largest median error of cameras that fit, as a fraction of the diagonal. The definition `keypoints` assumes 0.8 % of network and calibration.
LARGEST = 0.01


def describe_errors(cameras: Sequence[CameraAgreement]) -> str:
    """A line with the reprojection error of each camera."""
    errors = ", ".join(f"{camera.name} {camera.error_px:.1f} px ({100 * camera.error_px / camera.diagonal_px:.2f} %)" for camera in cameras)
    return f"Median reprojection error of the triangulated keypoints, in per cent of the image's diagonal: {errors}."


def warn_of_cameras(cameras: Sequence[CameraAgreement], offsets: Mapping[str, int]) -> list[str]:
    """Sentences on cameras whose calibration or clock may be off; none if all is well.

    Args:
        cameras: compared with each other.
        offsets: those with which the session was imported (`--offset`), by camera.
    """
    return [*_warn_of_clocks(cameras, offsets), *(_warn_of_worst(cameras) or _warn_of_all(cameras))]


def _warn_of_clocks(cameras: Sequence[CameraAgreement], offsets: Mapping[str, int]) -> list[str]:
    sentences = []
    for camera in cameras:
        clock = camera.clock
        if clock is None or clock.frames == 0:
            continue
        reference = "the other cameras" if len(cameras) > 2 else f"camera '{cameras[0].name}'"
        between = f" ({clock.interpolated:+.1f} between frames)" if np.isfinite(clock.interpolated) else ""
        shown = f"frame k {'+' if clock.frames > 0 else '-'} {abs(clock.frames)} of camera '{camera.name}' fits frame k of {reference} best{between}"
        scatter = f"its keypoints scatter by {clock.scatter_px:.1f} px about their points, and by {clock.shifted_px:.1f} px if it is shifted"
        remedy = f"if it was not synchronised, import again with --offset {camera.name}={offsets.get(camera.name, 0) + clock.frames} --overwrite"
        sentences.append(f"{shown}: {scatter}; {remedy}.")
    return sentences


def _warn_of_worst(cameras: Sequence[CameraAgreement]) -> list[str]:
    """The camera that fits worst, if it fits clearly worse than the others."""
    if len(cameras) < 3:
        return []
    worst = max(cameras, key=lambda camera: camera.left_out_m)
    rivals = [camera for camera in cameras if camera is not worst]
    usual_px, usual_m = (float(np.median([getattr(camera, key) for camera in rivals])) for key in ("left_out_px", "left_out_m"))
    if worst.left_out_px <= UNSUSPECTED * worst.diagonal_px or worst.left_out_m <= WORSE * usual_m or worst.left_out_px <= WORSE * usual_px:
        return []
    distance = f"its keypoints are {worst.left_out_px:.0f} px ({100 * worst.left_out_px / worst.diagonal_px:.1f} % of the diagonal)"
    compared = f"{distance} from the points of the other cameras, those of the others {usual_px:.0f} px"
    remedy = "check its calibration, or remove its [[camera]] from session.toml"
    return [f"camera '{worst.name}' fits worse than the others: {compared} (median); its calibration or its clock may be off: {remedy}."]


def _warn_of_all(cameras: Sequence[CameraAgreement]) -> list[str]:
    """All cameras together, if their errors are large and no single one is to blame."""
    shares = [camera.error_px / camera.diagonal_px for camera in cameras]
    if max(shares, default=0.0) <= LARGEST:
        return []
    problem = f"the cameras do not fit each other: the median reprojection error is up to {100 * max(shares):.1f} % of the diagonal"
    remedy = "check that the calibration is that of this recording, and that the cameras are synchronised"
    return [f"{problem}, expected at most {100 * LARGEST:g} %; {remedy}."]
