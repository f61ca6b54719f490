"""Bodies against detections: how far each detection of a camera is from each body, and the body that detections of several cameras show.

With several cameras a body is (keypoint, 3), metres. With one camera it is (keypoint, 2), pixels, and a body is what was detected last.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from bayes_body.recording.readers.keypoints.person import FEWEST, People
from bayes_body.recording.readers.keypoints.triangulate import project, triangulate, triangulate_from_all
from bayes_body.recording.session.session import CameraSpec

type Bodies = Float[np.ndarray, "body keypoint _"]


def sizes_of(people: Float[np.ndarray, "*frame person keypoint 3"]) -> Float[np.ndarray, "*frame person"]:
    """Diagonals of the people's boxes, pixels; 0 for a person without keypoints."""
    places = people[..., :2]
    is_seen = np.isfinite(places).all(axis=-1, keepdims=True)
    lowest, highest = np.where(is_seen, places, np.inf).min(axis=-2), np.where(is_seen, places, -np.inf).max(axis=-2)
    extent = np.where(is_seen.any(axis=-2), highest - lowest, 0.0)
    return np.linalg.norm(extent, axis=-1)


def offsets_px(
    camera: CameraSpec, bodies: Float[np.ndarray, "*frame body keypoint _"], people: Float[np.ndarray, "*frame person keypoint 3"]
) -> Float[np.ndarray, "*frame body person keypoint"]:
    """Distances between the keypoints of bodies and of people in a camera, pixels; NaN where one is not known.

    Args:
        camera: calibrated.
        bodies: in the world, or in the image of the only camera.
        people: column, row (pixels; NaN where not seen) and confidence.
    """
    pixels = bodies if bodies.shape[-1] == 2 else project(camera, bodies.reshape(-1, 3)).reshape(*bodies.shape[:-1], 2)
    columns, rows = (pixels[..., :, None, :, i] - people[..., None, :, :, i] for i in range(2))
    return np.sqrt(columns * columns + rows * rows)


def distances_of_offsets(
    offsets: Float[np.ndarray, "*frame body person keypoint"], sizes_px: Float[np.ndarray, "*frame person"]
) -> Float[np.ndarray, "*frame body person"]:
    """Median offsets as fractions of the people's sizes; infinite where too few keypoints are shared.

    Args:
        offsets: pixels; NaN where a keypoint is not shared.
        sizes_px: of the people.
    """
    counts, sizes = (~np.isnan(offsets)).sum(axis=-1), sizes_px[..., None, :]
    # Sorting puts NaN last. Of an even number this is the larger of the middle two.
    middle = np.minimum(counts // 2, offsets.shape[-1] - 1)[..., None]
    medians = np.take_along_axis(np.sort(offsets, axis=-1), middle, axis=-1)[..., 0]
    return np.where((counts >= FEWEST) & (sizes > 0), medians / np.where(sizes > 0, sizes, 1.0), np.inf)


def distances(camera: CameraSpec, bodies: Bodies, people: People) -> Float[np.ndarray, "body person"]:
    """Median distances between bodies and people in a camera, as fractions of the people's sizes; infinite where too few keypoints are shared.

    Arguments as of `offsets_px`.
    """
    if not len(bodies) or not len(people):
        return np.full((len(bodies), len(people)), np.inf)
    return distances_of_offsets(offsets_px(camera, bodies, people), sizes_of(people))


def distances_in_all(cameras: Sequence[CameraSpec], bodies: Bodies, people: Sequence[People]) -> Float[np.ndarray, "camera body person"]:
    """Distances, as of `distances`, in all cameras at once; infinite for people that a camera does not have."""
    padded = np.full((len(cameras), max(map(len, people)), bodies.shape[1], 3), np.nan)
    for rows, group in zip(padded, people, strict=True):
        if len(group):
            rows[: len(group)] = group
    offsets = np.stack([offsets_px(camera, bodies, rows) for camera, rows in zip(cameras, padded, strict=True)])
    return distances_of_offsets(offsets, sizes_of(padded)) if padded.shape[1] else np.zeros(offsets.shape[:3])


def bodies_of(
    cameras: Sequence[CameraSpec], people: Sequence[People], places: Sequence[Sequence[int | None]], keypoints: int
) -> tuple[Float[np.ndarray, "body keypoint 3"], Float[np.ndarray, " body"]]:
    """The bodies that the chosen detections of several cameras show, and the largest distance of one from its body; a NaN body has an infinite one.

    A camera that is wrong about a keypoint moves the body: see `body_of`.

    Args:
        cameras: calibrated, at least two.
        people: for each camera.
        places: for each body, the chosen detection of each camera; None for none.
        keypoints: their number.
    """
    points = np.full((len(cameras), len(places), keypoints, 3), np.nan)
    for body, row in enumerate(places):
        for c, place in enumerate(row):
            if place is not None:
                points[c, body] = people[c][place]
    bodies = triangulate_from_all(cameras, points.reshape(len(cameras), -1, 3)).reshape(points.shape[1:])
    bodies[np.isfinite(bodies).all(axis=-1).sum(axis=-1) < FEWEST] = np.nan
    chosen = np.array([[place is not None for place in row] for row in places]).T
    pixels = np.stack([project(camera, bodies.reshape(-1, 3)).reshape(*bodies.shape[:-1], 2) for camera in cameras])
    offsets = np.sqrt(((pixels - points[..., :2]) ** 2).sum(axis=-1))
    misfits = distances_of_offsets(offsets[:, :, None, None], sizes_of(points)[..., None])[..., 0, 0]
    return bodies, np.where(chosen, misfits, 0.0).max(axis=0)


def body_of(
    cameras: Sequence[CameraSpec], people: Sequence[People], places: Sequence[int | None], is_robust: bool = True
) -> Float[np.ndarray, "keypoint _"] | None:
    """The body that the chosen detections show; None if too few cameras have one, or they share too few keypoints.

    Args:
        cameras: calibrated.
        people: for each camera.
        places: the chosen detection of each camera; None for none.
        is_robust: whether cameras that are wrong about a keypoint are left out. It takes seven times as long.
    """
    chosen = [(camera, group[place]) for camera, group, place in zip(cameras, people, places, strict=True) if place is not None]
    if len(chosen) < min(2, len(cameras)):
        return None
    seeing, points = [camera for camera, _ in chosen], np.stack([person for _, person in chosen])
    if len(cameras) == 1:
        body = points[0, :, :2].copy()
    else:
        body = triangulate(seeing, points).points_m if is_robust else triangulate_from_all(seeing, points)
    return body if np.isfinite(body).all(axis=-1).sum() >= FEWEST else None
