"""The markers and keypoints of a session's first pose as arrays, with a check of every value."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float

from bayes_body.base.errors import FaultyFileError, InputError, nearest
from bayes_body.base.geometry.namespaces import device_array
from bayes_body.initial.fitting.points import FACE, Points
from bayes_body.recording.readers.keypoints.openpose import LAYOUTS
from bayes_body.recording.session.session import CameraSpec, Session

# With fewer points, the prior alone would determine the pose.
FEWEST = 4
# Fraction of the image's size: if the image cuts a person off, networks place points a little outside of it.
MARGIN = 0.1
PREFIX = "session.toml: initial"
DETECTED = frozenset(name for names in LAYOUTS.values() for name in names)


class Measurements(NamedTuple):
    """Measured positions of the body's points (`Points`), one row for each point. The weight is 0 where a point was not measured.

    Attributes:
        markers: positions in the world, metres.
        marker_weights: 1 for a given marker, else 0.
        pixels: (column, row) in each camera.
        rays: the pixels with the lens distortion removed, as (x, y) at depth 1 of each camera.
        pixel_weights: confidences of the keypoints.
    """

    markers: Float[Array, "point 3"]
    marker_weights: Float[Array, " point"]
    pixels: Float[Array, "camera point 2"]
    rays: Float[Array, "camera point 2"]
    pixel_weights: Float[Array, "camera point"]


def read_measurements(session: Session, points: Points) -> Measurements:
    """Read the session's markers and keypoints; names that do not belong to a point of the body are ignored.

    Raises:
        FaultyFileError: some values cannot be used; one sentence for each.
        InputError: too few points remain to fit a body to.
    """
    sentences = [*_faulty_markers(session), *_faulty_keypoints(session)]
    if sentences:
        raise FaultyFileError(sentences)
    markers, marker_weights = np.zeros((len(points.names), 3)), np.zeros(len(points.names))
    for name, place in session.initial_markers.items():
        k = points.index(name)
        if k is not None:
            markers[k], marker_weights[k] = place, 1.0
    pixels, weights = _keypoints(session, points)
    _check_enough(session, points, marker_weights, weights)
    rays = np.stack([_undistorted(view.camera, pixels[c]) for c, view in enumerate(session.views)])
    return Measurements(*(device_array(array) for array in (markers, marker_weights, pixels, rays, weights)))


def unused_names(session: Session, points: Points) -> Iterator[str]:
    """Yield remarks on names that do not belong to a point of the body: names that detectors use, and others, which may be misspelt."""
    measured_names = {*session.initial_markers, *(name for keypoints in session.initial_keypoints.values() for name in keypoints)}
    names = sorted(name for name in measured_names if points.index(name) is None)
    usual = [name for name in names if name in DETECTED]
    if usual:
        yield f"this body has no points {', '.join(usual)}; the pose was fitted to the other points"
    for name in (name for name in names if name not in DETECTED):
        yield f"'{name}' is not a point of this body and was not used; {nearest(name, points.names)}"


def _keypoints(session: Session, points: Points) -> tuple[Float[np.ndarray, "camera point 2"], Float[np.ndarray, "camera point"]]:
    shape = (len(session.views), len(points.names))
    pixels, weights = np.zeros((*shape, 2)), np.zeros(shape)
    for c, view in enumerate(session.views):
        for name, (u, v, confidence) in session.initial_keypoints.get(view.camera.name, {}).items():
            k = points.index(name)
            # If two names mean the same point, the keypoint with the higher confidence is used.
            if k is not None and confidence > weights[c, k]:
                pixels[c, k], weights[c, k] = (u, v), confidence
    return pixels, weights


def _check_enough(session: Session, points: Points, markers: Float[np.ndarray, " point"], weights: Float[np.ndarray, "camera point"]) -> None:
    if (
        session.initial_keypoints
        and not session.initial_markers
        and not any(p[2] for keypoints in session.initial_keypoints.values() for p in keypoints.values())
    ):
        raise InputError(
            f"{PREFIX}.keypoints_px: every confidence is 0; expected some above 0; give keypoints that were found, or the pose in angles."
        )
    is_given = (markers > 0) | (weights > 0).any(axis=0)
    body = [name for name in points.names if name not in FACE]
    measured = [name for name, is_known in zip(points.names, is_given, strict=True) if is_known and name in body]
    fewest = min(FEWEST, len(body))
    if len(measured) < fewest:
        problem = f"{len(measured)} points of the body ({', '.join(measured) or 'none'})"
        raise InputError(
            f"{PREFIX}: {problem}; expected at least {fewest} of {', '.join(body)}; give more markers or keypoints, or the pose in angles."
        )


def _faulty_markers(session: Session) -> Iterator[str]:
    for name, place in session.initial_markers.items():
        if not np.isfinite(place).all():
            yield f"{PREFIX}.markers_m.{name}: {tuple(place)}; expected three numbers in metres; correct it, or leave the marker out."


def _faulty_keypoints(session: Session) -> Iterator[str]:
    cameras = {view.camera.name: view.camera for view in session.views}
    for name, keypoints in session.initial_keypoints.items():
        if name not in cameras:
            yield f"{PREFIX}.keypoints_px.{name}: no camera of that name; expected one of {', '.join(cameras)}; rename it."
            continue
        if _is_singular(cameras[name]):
            yield f"camera '{name}': it maps space to a line or a point; expected a rotation and focal lengths above 0; calibrate it again."
        for keypoint, (u, v, confidence) in keypoints.items():
            yield from _faulty_keypoint(f"{PREFIX}.keypoints_px.{name}.{keypoint}", u, v, confidence, cameras[name].size_px)


def _faulty_keypoint(place: str, u: float, v: float, confidence: float, size: tuple[int, int]) -> Iterator[str]:
    if not (np.isfinite(confidence) and 0 <= confidence <= 1):
        yield f"{place}: confidence {confidence:g}; expected a number between 0 and 1; correct it, or leave the keypoint out."
    elif confidence > 0 and not all(-MARGIN * side <= value <= (1 + MARGIN) * side for value, side in zip((u, v), size, strict=True)):
        problem = f"({u:g}, {v:g}) lies outside its image of {size[0]} x {size[1]} px"
        yield f"{place}: {problem}; expected a column and a row inside the image; correct it, or leave the keypoint out."


def _is_singular(camera: CameraSpec) -> bool:
    numbers = np.concatenate([np.ravel(camera.rotation), np.ravel(camera.translation_m), camera.focal_px, camera.centre_px, camera.distortion])
    if not np.isfinite(numbers).all():
        return True
    return bool(abs(np.linalg.det(camera.rotation)) < 0.5 or min(camera.focal_px) <= 0)


def _undistorted(camera: CameraSpec, pixels: Float[np.ndarray, "point 2"]) -> Float[np.ndarray, "point 2"]:
    """Return the points at depth 1 that the camera sees at these pixels, by fixed-point iteration."""
    yd = (pixels[:, 1] - camera.centre_px[1]) / camera.focal_px[1]
    xd = (pixels[:, 0] - camera.centre_px[0]) / camera.focal_px[0] - camera.skew * yd
    k1, k2, p1, p2, k3 = camera.distortion
    x, y = xd, yd
    for _ in range(30):
        r2 = x * x + y * y
        # Beyond its turning point the lens polynomial falls to 0 and has no inverse: stay near that point.
        radial = np.maximum(1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 0.3)
        x, y = (xd - 2 * p1 * x * y - p2 * (r2 + 2 * x * x)) / radial, (yd - p1 * (r2 + 2 * y * y) - 2 * p2 * x * y) / radial
    return np.stack([x, y], axis=1)
