"""The background of a camera that stands still: one Gaussian per pixel, learned once and then fixed.

What is computed from a frame therefore depends on that frame only, and not on the frames that were read before.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from bayes_body.recording.observation.empty_scene import SAME_COLOUR, background_frames
from bayes_body.recording.observation.exposure import Exposure, fit_exposure
from bayes_body.recording.observation.pictures import Colours

# Longest side of the images used for segmentation, and of those used to decide which frames show the background.
LONGEST, LONGEST_SMALL = 640, 320
# Least standard deviation, grey levels. Compression errors are neither Gaussian nor independent: what a short learning missed is not foreground.
LEAST_SD = 3.0
# Standard deviation for a background from a single image, or for a pixel that was seen once.
UNKNOWN_SD = 6.0
# If no pixel's channels differ by more than this, the camera is grey.
GREY = 8


class Background(NamedTuple):
    """Mean and standard deviation of each pixel, grey levels, at the segmentation's image size; one channel if the camera is grey.

    Attributes:
        mean: the empty scene.
        sd: the standard deviation of a pixel that shows the background.
        doubtful: where the person may have been learned as background.
    """

    mean: Float[np.ndarray, "row column channel"]
    sd: Float[np.ndarray, "row column channel"]
    doubtful: Bool[np.ndarray, "row column"]


def shrink(image: NDArray[np.uint8], longest: int = LONGEST) -> NDArray[np.uint8]:
    """The image scaled so that its longest side has `longest` pixels; each new pixel is the mean of the area that it covers."""
    height, width = image.shape[:2]
    scale = longest / max(height, width)
    if scale >= 1:
        return image
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def still_background(image: Colours) -> Background:
    """The background from one image of the empty scene."""
    mean = _channels(shrink(image)).astype(np.float32)
    return Background(mean, np.full_like(mean, UNKNOWN_SD), np.zeros(mean.shape[:2], bool))


def learn_background(images: Sequence[Colours], follow_exposure: bool) -> Background:
    """Learn the background from frames of a recording, in temporal order and of one size. People may pass through them.

    Args:
        images: at most 640 pixels high and wide (`shrink`).
        follow_exposure: whether the frames are first brought to the same brightness.
    """
    images = _even(images) if follow_exposure else images
    shown = background_frames(np.stack([shrink(image, LONGEST_SMALL) for image in images]))
    size = images[0].shape[1::-1]
    where = [cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)[..., None] > 0 for mask in shown.frames]
    colours = [_channels(image) for image in images]
    first, _ = _moments(colours, where)
    # Small images mix neighbouring pixels: at edges, some pixels that they call background are not.
    near = [
        mask & (((image - first) ** 2).sum(axis=-1, keepdims=True) < (1.5 * SAME_COLOUR) ** 2) for image, mask in zip(colours, where, strict=True)
    ]
    mean, sd = _moments(colours, near, first)
    doubtful = cv2.resize(shown.doubtful.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    return Background(mean, np.maximum(sd, LEAST_SD), doubtful)


def _even(images: Sequence[Colours]) -> list[Colours]:
    """Bring all images to the brightness of their median. Images of something else are dropped, unless all are."""
    middle = np.median([shrink(image, LONGEST_SMALL) for image in images[:: max(1, len(images) // 40)]], axis=0).astype(np.float32)
    fits = [(image, fit_exposure(shrink(image, LONGEST_SMALL), middle)) for image in images]
    return [_undo(image, exposure) for image, exposure in fits if exposure is not None] or list(images)


def _undo(image: Colours, exposure: Exposure) -> Colours:
    offset = cv2.resize(exposure.offset, image.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    return np.clip((image - offset) / exposure.gain + 0.5, 0, 255).astype(np.uint8)


def _channels(image: Colours) -> NDArray[np.uint8]:
    """(row, column, 3), or (row, column, 1) if the camera is grey."""
    return image[..., :1] if np.percentile(np.ptp(image[::4, ::4].astype(np.int16), axis=-1), 99) < GREY else image


def _moments(
    images: Sequence[NDArray[np.uint8]], where: Sequence[NDArray[np.bool_]], otherwise: NDArray[np.float32] | None = None
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Mean and standard deviation over the images in which a pixel counts. A pixel that never counts gets `otherwise` and an unknown deviation."""
    count = np.zeros((*images[0].shape[:2], 1), np.float32)
    total, squares = np.zeros(images[0].shape, np.float32), np.zeros(images[0].shape, np.float32)
    for image, mask in zip(images, where, strict=True):
        values = image * mask.astype(np.float32)
        count += mask
        total += values
        squares += values * values
    mean = total / np.maximum(count, 1)
    sd = np.sqrt(np.maximum(squares / np.maximum(count, 1) - mean**2, 0))
    if otherwise is not None:
        mean = np.where(count > 0, mean, otherwise)
    return mean.astype(np.float32), np.where(count > 1, sd, UNKNOWN_SD).astype(np.float32)
