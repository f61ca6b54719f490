"""Where a camera sees points of the world, and in which frames it sees the person. Uses OpenCV's projection, not the model's."""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float

from bayes_body.base.errors import FaultyFileError, input_error
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.readers.rig import Rig
from bayes_body.recording.session.session import CameraSpec

# A marker nearer to the camera than this (metres) is not visible.
NEAR_M = 0.1
# A camera sees the person if it sees this many of the 15 markers. It is useful if it does so in this fraction of the frames.
SEEN_MARKERS, LEAST_SHARE = 8, 0.1
# A detector misses a person of whom fewer markers are visible.
DETECTED_MARKERS = 5
# A detector's confidence: for a point without error, its loss per standard deviation of error, and its own standard deviation.
CONFIDENCE, LOST_A_SD, CONFIDENCE_SD, LEAST_CONFIDENCE = 0.95, 0.06, 0.04, 0.3


def pixels(camera: CameraSpec, points: Float[np.ndarray, "point 3"]) -> tuple[Float[np.ndarray, "point 2"], Bool[np.ndarray, " point"]]:
    """Column and row of each point (metres), and whether it is in front of the camera and inside the image."""
    points = np.asarray(points, np.float64)
    K = np.array([[camera.focal_px[0], 0, camera.centre_px[0]], [0, camera.focal_px[1], camera.centre_px[1]], [0, 0, 1]])
    turned = cv2.Rodrigues(camera.rotation)[0]
    uv_px = cv2.projectPoints(points.reshape(-1, 1, 3), turned, camera.translation_m, K, np.array(camera.distortion))[0].reshape(-1, 2)
    # OpenCV's camera matrix would ignore the skew.
    uv_px[:, 0] += camera.skew * camera.focal_px[0] / camera.focal_px[1] * (uv_px[:, 1] - camera.centre_px[1])
    inside = points @ camera.rotation.T + camera.translation_m
    # A lens model can map points far outside the field of view back into the image.
    straight = np.abs(inside[:, :2]).max(axis=1) < 1.5 * inside[:, 2] * max(np.divide(camera.size_px, camera.focal_px))
    return uv_px, (inside[:, 2] > NEAR_M) & straight & (uv_px > -0.5).all(axis=1) & (uv_px < np.array(camera.size_px) - 0.5).all(axis=1)


def frames_seen(cameras: Sequence[CameraSpec], markers: Float[np.ndarray, "frame marker 3"]) -> Bool[np.ndarray, " frame"]:
    """In which frames a camera, given for each frame, sees most of the person."""
    return np.array([pixels(camera, points)[1].sum() >= SEEN_MARKERS for camera, points in zip(cameras, markers, strict=True)])


def check_visibility(rig: Rig, markers: Float[np.ndarray, "frame marker 3"]) -> list[str]:
    """Refuse a rig with a camera that hardly ever sees the person.

    Returns:
        Remarks, one sentence for each camera that does not see the person in all frames.

    Raises:
        FaultyFileError: one sentence for each camera that sees the person in less than a tenth of the frames.
    """
    faults, remarks = [], []
    middle = np.nanmean(markers, axis=(0, 1))
    for camera, posed in zip(rig.cameras, rig.posed(len(markers)), strict=True):
        count = int(frames_seen(posed, markers).sum())
        problem = f"sees the person in {count} of {len(markers)} frames"
        if count < LEAST_SHARE * len(markers):
            expected = f"a camera that sees the person, who is around ({', '.join(f'{value:.1f}' for value in middle)}) m"
            remedy = "turn it there, move it back or widen its lens (a smaller focal_px), or exclude it with --cameras"
            faults.append(str(input_error(f"rig {rig.name}: camera '{camera.name}'", problem, expected, remedy)))
        elif count < len(markers):
            remarks.append(f"camera '{camera.name}' {problem}; fewer frames (--frames) or a rig that covers a larger area would show all of them.")
    if faults:
        raise FaultyFileError(faults)
    return remarks


def detect_people(
    rng: np.random.Generator,
    camera: CameraSpec,
    people: Float[np.ndarray, "person 15 3"],
    masks: Bool[np.ndarray, "person row column"],
    sd_px: float,
) -> Float[np.ndarray, "detection 15 3"]:
    """Detections of people in one frame, in random order: column, row, confidence of the markers; NaN where a marker is not detected.

    A marker is not detected where another person is in front of it, and a person with fewer than `DETECTED_MARKERS` is missing.

    Args:
        rng: for errors and order.
        camera: the camera.
        people: true markers, metres.
        masks: where each person is visible.
        sd_px: standard deviation of the errors, pixels.
    """
    detections = []
    for number, markers in enumerate(people):
        keypoints = detected(rng, camera, dict(zip(MARKERS, markers, strict=True)), sd_px)
        detection = np.array([keypoints.get(name, (np.nan,) * 3) for name in MARKERS])
        hidden = np.delete(masks, number, axis=0).any(axis=0)
        column, row = np.clip(np.rint(np.nan_to_num(pixels(camera, markers)[0])), 0, np.array(camera.size_px) - 1).astype(int).T
        detection[hidden[row, column]] = np.nan
        if np.isfinite(detection[:, 0]).sum() >= DETECTED_MARKERS:
            detections.append(detection)
    return np.array(detections)[rng.permutation(len(detections))].reshape(-1, len(MARKERS), 3)


def detected(
    rng: np.random.Generator, camera: CameraSpec, markers: Mapping[str, Float[np.ndarray, "3"]], sd_px: float
) -> dict[str, tuple[float, float, float]]:
    """Keypoints of a detector in one frame: column, row, confidence, for those of the 15 markers that are in the image."""
    names = [name for name in MARKERS if np.isfinite(markers[name]).all()]
    image_points, visibility = pixels(camera, np.stack([markers[name] for name in names]))
    error = rng.normal(0, 1, image_points.shape)
    wobble = rng.normal(0, CONFIDENCE_SD, len(names))
    confidence = np.clip(CONFIDENCE - LOST_A_SD * np.linalg.norm(error, axis=1) + wobble, LEAST_CONFIDENCE, 1)
    columns, rows = np.clip(image_points + sd_px * error, 0, np.array(camera.size_px) - 1.0).T
    values = zip(names, columns, rows, confidence, visibility, strict=True)
    return {name: (round(float(u), 2), round(float(v), 2), round(float(c), 3)) for name, u, v, c, is_visible in values if is_visible}
