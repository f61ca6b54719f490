"""Pictures turned so that the world's up is up, cut around the head where it is known."""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float

from bayes_body.initial.detection.scene import Scene
from bayes_body.recording.observation.pictures import Colours
from bayes_body.recording.readers.triangulate import project

# The picture around a known head: its side in metres, and pixels a metre (a face is then about 50 pixels wide).
SIDE_M, PIXELS_PER_M = 0.5, 280.0
# Without a known head: the distance at which the direction of up is taken, metres, and the largest side of the picture.
AHEAD_M, SIDE_PX = 3.0, 900


class Upright(NamedTuple):
    """A turned picture.

    Attributes:
        picture: blue, green and red.
        matrix: takes (column, row, 1) of the picture to column and row of the camera's image.
        scale: the picture's pixels for one pixel of the image.
        pixels_per_m: the picture's pixels for a metre at the head; None if the head is not known.
    """

    picture: Colours
    matrix: Float[np.ndarray, "2 3"]
    scale: float
    pixels_per_m: float | None

    def to_image(self, pixel: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
        """A pixel of the picture in the camera's image."""
        return self.matrix @ np.append(pixel, 1.0)


def upright(scene: Scene, view: int) -> Upright:
    """The picture of a view, turned; around the head of the visual hull if there is one, else all of it."""
    camera = scene.cameras[view]
    if scene.figure is None:
        place = scene.viewpoints[view] + AHEAD_M * camera.rotation[2]
        size = np.array(camera.size_px, float)
        side = float(np.hypot(*size))
        scale = min(2.0, SIDE_PX / side)
        return _turned(scene, view, place, (size - 1) / 2, scale, round(side * scale), None)
    place = scene.figure.crown - 0.1 * scene.upwards
    metre = max(camera.focal_px) / float(np.linalg.norm(place - scene.viewpoints[view]))
    return _turned(scene, view, place, project(camera, place[None])[0], PIXELS_PER_M / metre, round(SIDE_M * PIXELS_PER_M), PIXELS_PER_M)


def _turned(
    scene: Scene, view: int, place: Float[np.ndarray, "3"], middle: Float[np.ndarray, "2"], scale: float, side: int, pixels_per_m: float | None
) -> Upright:
    low, high = project(scene.cameras[view], np.stack([place, place + 0.1 * scene.upwards]))
    down = low - high
    length = float(np.linalg.norm(down))
    # Looking straight down or up, or a head behind the camera: nothing to turn.
    down = down / length if np.isfinite(length) and length > 1e-6 else np.array([0.0, 1.0])
    middle = np.where(np.isfinite(middle), middle, 0.0)
    # The picture's columns run to the right of down, its rows along down.
    axes = np.column_stack([[down[1], -down[0]], down]) / scale
    matrix = np.column_stack([axes, middle - axes @ np.full(2, (side - 1) / 2)])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    picture = cv2.warpAffine(scene.pictures[view], matrix, (side, side), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return Upright(np.asarray(picture, np.uint8), matrix, scale, pixels_per_m)
