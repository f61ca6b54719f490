"""The pictures of a frame and of the frame before, for the likelihood `image_motion` (Sidenbladh, Black & Fleet 2000, 4).

A Gaussian smooths the pictures, as in the paper, so that their difference has a gradient over a few pixels. The background of a camera that stands
still stays where it is. The background of a camera that moves is carried by a homography, which is found by following corners; most corners are not
on the person. The points that are compared are a fixed grid on each part, so that the density is a function of the state alone. With `random`, they
are drawn anew for each frame, as in the paper, the same for all particles.

How the background moves from the frame before to this one, in pixels: corners are followed, most of which are not on the person.
"""

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from bayes_body.base.registry import register
from bayes_body.base.toml.schema import Count, Positive, Schema
from bayes_body.recording.evidence.image_motion import LEVELS, ImageMotion, random_places, stratified
from bayes_body.recording.evidence.silhouette_edges import Levels, pack, quantised
from bayes_body.recording.observation.frames import Frame
from bayes_body.recording.observation.pictures import Greys

CORNERS, FEWEST, QUALITY, APART_PX = 300, 20, 0.01, 8
# A corner that a motion of the background explains is this near to where it belongs.
WITHIN_PX = 1.0


def corner_ways(previous_picture: Greys, picture: Greys) -> Float[np.ndarray, "2 corner 2"]:
    """Return the pixels of corners in the frame before and in this one. There are none if fewer than FEWEST are found again."""
    corners: Any = cv2.goodFeaturesToTrack(previous_picture, CORNERS, QUALITY, APART_PX)
    if corners is None or len(corners) < FEWEST:
        return np.empty((2, 0, 2))
    empty: Any = None
    moved, status, _ = cv2.calcOpticalFlowPyrLK(previous_picture, picture, corners, empty)
    ways = np.stack([corners, moved])[:, status.ravel() == 1].reshape(2, -1, 2)
    return ways if ways.shape[1] >= FEWEST else np.empty((2, 0, 2))


def carried_background(previous_picture: Greys, picture: Greys) -> Greys:
    """Return the picture of the frame before, carried to this frame as if everything moved with the background.

    The motion is a homography: exact for a camera that turns and for a plane, approximate for a room with depth. Where none is found, nothing moves.
    """
    start, end = corner_ways(previous_picture, picture)
    homography: Any = cv2.findHomography(start, end, cv2.RANSAC, WITHIN_PX)[0] if len(start) else None
    if homography is None:
        return previous_picture
    return np.asarray(
        cv2.warpPerspective(previous_picture, homography, previous_picture.shape[::-1], flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE),
        np.uint8,
    )


class Options(Schema):
    """Options of `[likelihood.observation]` of `image_motion`."""

    smooth_px: Positive = 1.414
    """[pixels] standard deviation of the Gaussian that smooths the pictures."""
    # Along a part and across it.
    samples: tuple[Count, Count] = (8, 4)
    """[samples] per part and camera: along the part, across it."""
    random: bool = False
    """whether points are drawn anew for each frame, as in the paper, instead of standing on a grid; they are the same for all particles."""


@register("observation", "image_motion", Options)
def build(options: Options, **_: Any) -> Callable[[Frame], ImageMotion]:
    """Pack the pictures of a frame and of the frame before. A frame without `before` has no pair."""

    def levels_of(image: Greys | None, shape: tuple[int, int]) -> Levels:
        empty_picture = np.empty((0, 0), np.float32)
        picture = empty_picture if image is None else cv2.GaussianBlur(image.astype(np.float32), (0, 0), options.smooth_px) / np.float32(LEVELS)
        return quantised(np.asarray(picture, np.float32), 0.0, shape)

    def observe(frame: Frame) -> ImageMotion:
        earlier = frame.before
        previous_pictures = (None,) * len(frame.images) if earlier is None else earlier.images
        # Without a frame before, any camera will do.
        nowhere = [(np.eye(3), np.zeros(3))] * len(previous_pictures)
        extrinsics = nowhere if earlier is None else [(camera.rotation, camera.translation_m) for camera in earlier.cameras]
        rotations, translations = (np.stack(arrays).astype(np.float32) for arrays in zip(*extrinsics, strict=True))
        pairs = list(zip(frame.images, previous_pictures, strict=True))
        moves = (
            [False] * len(pairs)
            if earlier is None
            else [camera != earlier_camera for camera, earlier_camera in zip(frame.cameras, earlier.cameras, strict=True)]
        )
        pictures = [(*pair, _background(*pair, moved)) for pair, moved in zip(pairs, moves, strict=True)]
        places = random_places(*options.samples, frame.index) if options.random else stratified(*options.samples)
        return ImageMotion(
            pack(np.stack([np.stack([levels_of(image, frame.largest) for image in three]) for three in pictures])),
            rotations,
            translations,
            places.astype(np.float32),
            np.array([image is not None and earlier_image is not None for image, earlier_image in pairs]),
        )

    return observe


def _background(picture: Greys | None, previous_picture: Greys | None, moves: bool) -> Greys | None:
    return carried_background(previous_picture, picture) if moves and picture is not None and previous_picture is not None else previous_picture
