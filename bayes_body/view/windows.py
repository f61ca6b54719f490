"""The part of each camera's image that shows the person.

All frames of a video have the same size, so a window keeps its size for the whole track. Its centre follows the person and is smoothed over time, so
that the picture does not shake. The windows of all cameras have the same shape, so that their tiles form a grid without gaps.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from cv2.typing import MatLike
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from bayes_body.model.build import Model
from bayes_body.recording.session.session import Session
from bayes_body.results.metrics.fit import outlines, seen_in

TILE_HEIGHT = 480
# Of a still, on which one centimetre of a person can be judged: a person who fills it has four pixels a centimetre.
STILL_HEIGHT = 1080
# Grey level where there is no image.
EMPTY = 30
# Room around the person's box, as a fraction of its longer side: the hands and feet of the person extend beyond a body without them.
MARGIN = 0.15
# Standard deviation of the smoothing of the centre, seconds.
SMOOTHING_S = 0.3
# The same in frames, at most: the smoothing takes memory for each of them.
MOST_SMOOTHING = 1000
# Narrowest and widest shape, width / height; and the largest zoom, tile pixels per image pixel. Instead of more zoom, a window shows more of the
# scene.
SHAPES, MOST_ZOOM = (0.6, 1.6), 3.0
# Width / height of the screen on which all tiles are shown.
SCREEN = 1.6


class Window(NamedTuple):
    """A rectangle of one camera's image that moves with the person, and the tile that shows it.

    Attributes:
        size: (width, height), image pixels.
        centres: (column, row) in each frame, image pixels.
        tile: (width, height), pixels.
    """

    size: tuple[int, int]
    centres: Float[np.ndarray, "frame 2"]
    tile: tuple[int, int]

    def cut(self, image: MatLike, frame: int) -> MatLike:
        """Return the tile of a frame; the area outside of the image is dark grey."""
        pads = [max(0, -(-(size - length) // 2)) for size, length in zip(self.size, image.shape[1::-1], strict=True)]
        padded = cv2.copyMakeBorder(image, pads[1], pads[1], pads[0], pads[0], cv2.BORDER_CONSTANT, value=(EMPTY,) * 3)
        centre = self.centres[frame] + pads
        shrinks = self.tile[0] < self.size[0]
        return cv2.resize(cv2.getRectSubPix(padded, self.size, centre), self.tile, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)

    def scaled(self, height: int) -> "Window":
        """Return the same window with a tile of that height."""
        width, tile_height = self.tile
        return self._replace(tile=(2 * round(width * height / tile_height / 2), height))

    def place(self, points: Float[np.ndarray, "point 2"], frame: int) -> Float[np.ndarray, "point 2"]:
        """Return the positions of image points, (column, row), in the tile of a frame."""
        size = np.array(self.size)
        # Integer coordinates are the centres of pixels, in the image and in the tile.
        return (points - self.centres[frame] + size / 2) * self.tile / size - 0.5


def person_windows(session: Session, model: Model, poses: Float[np.ndarray, "frame *shape"], frames: range | None = None) -> list[Window]:
    """Return, for each camera, a window that contains the posed body in every frame.

    Args:
        session: the recording.
        model: its body and cameras.
        poses: one for each of the frames, radians and metres.
        frames: the frames' numbers; by default those from the first on. Windows count them from 0.

    Raises:
        InputError: a moving camera's file cannot be read.
    """
    frames = range(len(poses)) if frames is None else frames
    boxes = np.stack([body_boxes(session, seen_in(model, session, index), pose) for index, pose in zip(frames, poses, strict=True)])
    return windows_around(session, boxes, frames.step)


def windows_around(session: Session, boxes: Float[np.ndarray, "frame camera 2 2"], step: int = 1) -> list[Window]:
    """Return, for each camera, a window that contains a box in every frame.

    Args:
        session: the recording.
        boxes: smallest and largest (column, row) of what is shown, such as those of `body_boxes`; NaN in a frame without it.
        step: number of the recording's frames from one frame of the boxes to the next.
    """
    sizes = [np.array(view.camera.size_px, float) for view in session.views]
    paths = [_followed(boxes[:, c], size, session.fps / step) for c, size in enumerate(sizes)]
    shape = float(np.clip(np.median([width / height for _, (width, height) in paths]), *SHAPES))
    return [_window(centres, needed, size, shape) for (centres, needed), size in zip(paths, sizes, strict=True)]


def body_boxes(session: Session, model: Model, pose: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "camera 2 2"]:
    """Return the smallest and largest (column, row) of the body inside each image; NaN if no part of it is there."""
    boxes = np.full((len(session.views), 2, 2), np.nan)
    for c, parts in enumerate(outlines(model, pose)):
        if parts:
            points = np.concatenate([part.polygon for part in parts])
            box = np.clip([points.min(axis=0), points.max(axis=0)], 0, session.views[c].camera.size_px)
            if (box[1] > box[0]).all():
                boxes[c] = box
    return boxes


def _followed(
    boxes: Float[np.ndarray, "frame 2 2"], image: Float[np.ndarray, " 2"], fps: float
) -> tuple[Float[np.ndarray, "frame 2"], Float[np.ndarray, " 2"]]:
    """Return smooth centres, and the (width, height) around them that contains all boxes and the margin; the whole image if there is no box."""
    shown_frames = np.flatnonzero(np.isfinite(boxes).all(axis=(1, 2)))
    if not shown_frames.size:
        return np.tile(image / 2, (len(boxes), 1)), image
    middles = boxes[shown_frames].mean(axis=1)
    frames = np.arange(len(boxes))
    followed = np.stack([np.interp(frames, shown_frames, middles[:, axis]) for axis in range(2)], axis=1)
    centres = gaussian_filter1d(followed, min(SMOOTHING_S * fps, MOST_SMOOTHING), axis=0, mode="nearest")
    reach = np.maximum(boxes[shown_frames, 1] - centres[shown_frames], centres[shown_frames] - boxes[shown_frames, 0]).max(axis=0)
    return centres, np.minimum(2 * (reach + MARGIN * 2 * reach.max()), image)


def _window(centres: Float[np.ndarray, "frame 2"], needed: Float[np.ndarray, " 2"], image: Float[np.ndarray, " 2"], shape: float) -> Window:
    """Return the window of that shape that contains the needed area, inside the image if it fits."""
    height = max(needed[1], needed[0] / shape, TILE_HEIGHT / MOST_ZOOM)
    size = np.array([height * shape, height])
    edge = np.minimum(size, image) / 2
    width = 2 * round(TILE_HEIGHT * shape / 2)
    columns, rows = size.round().astype(int)
    return Window((int(columns), int(rows)), np.clip(centres, edge, image - edge), (width, TILE_HEIGHT))


def columns_of(count: int, width: float, height: int) -> int:
    """Return the number of tiles of (width, height) in a row for which all tiles are largest on SCREEN; the smallest such number."""
    return max(range(1, count + 1), key=lambda columns: min(SCREEN / (columns * width), 1 / (-(-count // columns) * height)))


def grid(tiles: Sequence[MatLike]) -> MatLike:
    """Return tiles of the same height in rows; the size is even, as video codecs require."""
    height = tiles[0].shape[0]
    columns = columns_of(len(tiles), float(np.mean([tile.shape[1] for tile in tiles])), height)
    rows = [np.hstack(tiles[i : i + columns]) for i in range(0, len(tiles), columns)]
    width = max(row.shape[1] for row in rows)
    width += width % 2
    filled = [cv2.copyMakeBorder(row, 0, 0, 0, width - row.shape[1], cv2.BORDER_CONSTANT, value=(EMPTY,) * 3) for row in rows]
    return np.vstack([*filled, np.full((1, width, 3), EMPTY, np.uint8)][: len(filled) + (len(filled) * height) % 2])
