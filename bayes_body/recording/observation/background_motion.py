"""How the background moves from the frame before to this one, in pixels: corners are followed, most of which are not on the person."""

from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from bayes_body.recording.observation.pictures import Greys

CORNERS, FEWEST, QUALITY, APART_PX = 300, 20, 0.01, 8
# A corner that a motion of the background explains is this near to where it belongs.
WITHIN_PX = 1.0


def corner_ways(before: Greys, picture: Greys) -> Float[np.ndarray, "2 corner 2"]:
    """Return the pixels of corners in the frame before and in this one. There are none if fewer than FEWEST are found again."""
    corners: Any = cv2.goodFeaturesToTrack(before, CORNERS, QUALITY, APART_PX)
    if corners is None or len(corners) < FEWEST:
        return np.empty((2, 0, 2))
    empty: Any = None
    moved, status, _ = cv2.calcOpticalFlowPyrLK(before, picture, corners, empty)
    ways = np.stack([corners, moved])[:, status.ravel() == 1].reshape(2, -1, 2)
    return ways if ways.shape[1] >= FEWEST else np.empty((2, 0, 2))


def carried_background(before: Greys, picture: Greys) -> Greys:
    """Return the picture of the frame before, carried to this frame as if everything moved with the background.

    The motion is a homography: exact for a camera that turns and for a plane, approximate for a room with depth. Where none is found, nothing moves.
    """
    start, end = corner_ways(before, picture)
    homography: Any = cv2.findHomography(start, end, cv2.RANSAC, WITHIN_PX)[0] if len(start) else None
    if homography is None:
        return before
    return np.asarray(cv2.warpPerspective(before, homography, before.shape[::-1], flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8)
