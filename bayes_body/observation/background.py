"""The background of a camera that stands still: a Gaussian for each pixel, learned once and then never changed.

So what is made of a frame is a function of that frame alone, whichever frames were looked at before it.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from bayes_body.observation.empty_scene import SAME_COLOUR, background_frames
from bayes_body.observation.exposure import Exposure, fit_exposure
from bayes_body.observation.pictures import Colours

# Longest side of the images that are worked on, and of those in which it is decided which frames show the background.
LONGEST, LONGEST_SMALL = 640, 320
# Grey levels. Compression's errors are neither Gaussian nor independent: what a short learning did not show must not count as foreground.
LEAST_SD = 3.0
# Of a background that is a single image, or a pixel that was seen once.
UNKNOWN_SD = 6.0
# Channels that differ by less everywhere are those of a grey camera.
GREY = 8


class Background(NamedTuple):
    """Mean and standard deviation of each pixel, grey levels, at the size that is worked on; one channel if the camera is grey.

    Attributes:
        mean: the empty scene.
        sd: how much a pixel varies of itself.
        doubtful: where it may be the person who was learned.
    """

    mean: Float[np.ndarray, "row column channel"]
    sd: Float[np.ndarray, "row column channel"]
    doubtful: Bool[np.ndarray, "row column"]


def shrink(image: NDArray[np.uint8], longest: int = LONGEST) -> NDArray[np.uint8]:
    """The image with its longest side brought down to `longest` pixels, each the mean of what it covers."""
    height, width = image.shape[:2]
    scale = longest / max(height, width)
    if scale >= 1:
        return image
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def still_background(image: Colours) -> Background:
    """From one image of the empty scene."""
    mean = _channels(shrink(image)).astype(np.float32)
    return Background(mean, np.full_like(mean, UNKNOWN_SD), np.zeros(mean.shape[:2], bool))


def learn_background(images: Sequence[Colours], follow_exposure: bool) -> Background:
    """From frames of a recording, in the order of time, all of one size; people may pass through them.

    Args:
        images: at most 640 pixels high and wide (`shrink`).
        follow_exposure: whether frames are first brought to the same brightness.
    """
    images = _even(images) if follow_exposure else images
    shown = background_frames(np.stack([shrink(image, LONGEST_SMALL) for image in images]))
    size = images[0].shape[1::-1]
    where = [cv2.resize(each.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)[..., None] > 0 for each in shown.frames]
    colours = [_channels(image) for image in images]
    first, _ = _moments(colours, where)
    # Small images mix neighbouring pixels: at edges some of what they say is background is not.
    near = [
        here & (((image - first) ** 2).sum(axis=-1, keepdims=True) < (1.5 * SAME_COLOUR) ** 2) for image, here in zip(colours, where, strict=True)
    ]
    mean, sd = _moments(colours, near, first)
    doubtful = cv2.resize(shown.doubtful.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    return Background(mean, np.maximum(sd, LEAST_SD), doubtful)


def _even(images: Sequence[Colours]) -> list[Colours]:
    """All at the brightness of their median; a frame that shows something else is left out, unless all do."""
    middle = np.median([shrink(image, LONGEST_SMALL) for image in images[:: max(1, len(images) // 40)]], axis=0).astype(np.float32)
    fits = [(image, fit_exposure(shrink(image, LONGEST_SMALL), middle)) for image in images]
    return [_undo(image, exposure) for image, exposure in fits if exposure is not None] or list(images)


def _undo(image: Colours, exposure: Exposure) -> Colours:
    offset = cv2.resize(exposure.offset, image.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    return np.clip((image - offset) / exposure.gain + 0.5, 0, 255).astype(np.uint8)


def _channels(image: Colours) -> NDArray[np.uint8]:
    """(row, column, 3), or (row, column, 1) of a grey camera."""
    return image[..., :1] if np.percentile(np.ptp(image[::4, ::4].astype(np.int16), axis=-1), 99) < GREY else image


def _moments(
    images: Sequence[NDArray[np.uint8]], where: Sequence[NDArray[np.bool_]], otherwise: NDArray[np.float32] | None = None
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Mean and standard deviation over the images where they count; `otherwise`, and an unknown deviation, of a pixel that never does."""
    count = np.zeros((*images[0].shape[:2], 1), np.float32)
    total, squares = np.zeros(images[0].shape, np.float32), np.zeros(images[0].shape, np.float32)
    for image, here in zip(images, where, strict=True):
        values = image * here.astype(np.float32)
        count += here
        total += values
        squares += values * values
    mean = total / np.maximum(count, 1)
    sd = np.sqrt(np.maximum(squares / np.maximum(count, 1) - mean**2, 0))
    if otherwise is not None:
        mean = np.where(count > 0, mean, otherwise)
    return mean.astype(np.float32), np.where(count > 1, sd, UNKNOWN_SD).astype(np.float32)
