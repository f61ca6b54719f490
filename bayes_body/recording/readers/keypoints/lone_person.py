"""Frames in which every camera sees one person or none, and all clearly the same one: there is no choice, and many frames are decided at once.

Following a person frame by frame takes some milliseconds a frame, most of it to find out which cameras agree. Here all cameras are used, and only
frames with half of the errors that following would accept are decided.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from bayes_body.recording.readers.keypoints.person import FEWEST, NEAR, SAME, People
from bayes_body.recording.readers.keypoints.triangulate import reprojection_errors, triangulate_from_all
from bayes_body.recording.session.session import CameraSpec

# Share of the errors that are accepted in single frames, for the frame's own body and for that of the frame before.
CLEARLY = 0.5


def lone_bodies(cameras: Sequence[CameraSpec], frames: Sequence[Sequence[People]]) -> list[Float[np.ndarray, "keypoint 3"] | None]:
    """The bodies, metres, of frames that need no choice; None for other frames, and for a frame after one of these.

    Args:
        cameras: calibrated.
        frames: successive ones, for each camera column, row (pixels; NaN where not visible) and confidence.
    """
    count = max((group.shape[1] for people in frames for group in people if len(group)), default=0)
    has_one = [max(map(len, people)) == 1 and sum(map(len, people)) >= 2 for people in frames]
    if len(cameras) < 2 or sum(has_one) < 2:
        return [None] * len(frames)
    points = np.full((len(cameras), len(frames), count, 3), np.nan)
    for frame in np.flatnonzero(has_one).tolist():
        for c, group in enumerate(frames[frame]):
            if len(group):
                points[c, frame] = group[0]
    bodies = triangulate_from_all(cameras, points.reshape(len(cameras), -1, 3)).reshape(len(frames), count, 3)
    earlier_bodies = np.concatenate([np.full_like(bodies[:1], np.nan), bodies[:-1]])
    fits = np.array(has_one) & _fits(cameras, points, bodies, SAME)
    steady = fits & np.concatenate([[False], fits[:-1]]) & _fits(cameras, points, earlier_bodies, NEAR)
    return [body if is_steady else None for body, is_steady in zip(bodies, steady.tolist(), strict=True)]


def _fits(
    cameras: Sequence[CameraSpec],
    points: Float[np.ndarray, "camera frame keypoint 3"],
    bodies: Float[np.ndarray, "frame keypoint 3"],
    limit: float,
) -> Bool[np.ndarray, " frame"]:
    """Whether the person of every camera that sees one is clearly within a limit of the body, by the median error over the person's size."""
    errors = reprojection_errors(cameras, bodies.reshape(-1, 3), points.reshape(len(cameras), -1, 3)).reshape(points.shape[:3])
    counts = (~np.isnan(errors)).sum(axis=-1, keepdims=True)
    # Sorting puts NaN last. Of an even number this is the larger of the middle two.
    medians = np.take_along_axis(np.sort(errors, axis=-1), np.minimum(counts // 2, points.shape[2] - 1), axis=-1)[..., 0]
    visible = np.isfinite(points[..., :2]).all(axis=-1, keepdims=True)
    lowest, highest = np.where(visible, points[..., :2], np.inf).min(axis=2), np.where(visible, points[..., :2], -np.inf).max(axis=2)
    sees = visible.any(axis=(-1, -2))
    sizes = np.linalg.norm(np.where(sees[..., None], highest - lowest, 0.0), axis=-1)
    return (~sees | ((counts[..., 0] >= FEWEST) & (medians <= CLEARLY * limit * sizes))).all(axis=0)
