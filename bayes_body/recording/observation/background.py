r"""The background of a camera that stands still: one Gaussian per pixel, learned once and then fixed.

What is computed from a frame therefore depends on that frame only, and not on the frames that were read before. It is decided pixel by pixel which
frames show the background, even if a person stands in one place for most of the recording.

OpenCV's Gaussian mixture gives each pixel's most frequent colour. This is the background where it is visible most of the time; where a person stays,
it is the person. For pixels whose colour changes, and pixels enclosed by them, the background is therefore chosen among the observed colours k.
Colour k was seen at the times $T_k$ and has the mean $c_k$. The choice is

$$\operatorname*{argmax}_k \; e^{-\min(\|c_k - \bar c\|^2 / 2\sigma^2,\, m)}
  \sum_{t \in T_k} \frac{p(I_t \mid \text{scene})}{p(I_t \mid \text{person})}.$$

Here $\bar c$ is the colour expected from the constant pixels around (OpenCV's inpainting). The two densities are histograms of colours. The scene's
histogram uses the pixels that never change. The person's uses samples in the outer part of the changing region that differ from the background chosen
so far (at first: all samples of changing pixels).
A colour that is common in the scene and rare on the person wins even if it was seen for a tenth of the time. A background that is never visible
cannot be learned: such pixels keep a colour of the person and are marked as doubtful.

The result depends on the frames only: the same frames give the same background.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy.typing import NDArray

from bayes_body.recording.observation.exposure import Exposure, colour_bins, colour_histogram, fit_exposure, squared_length
from bayes_body.recording.observation.pictures import Colours

type Stack = UInt8[np.ndarray, "frame row column 3"]

# Distances in colour, grey levels: within the first a value is the pixel's background; within the second it belongs to a colour seen before.
SAME_COLOUR, SAME_MODE = 18.0, 10.0
# A pixel that has one colour for this share of the time counts as constant.
CONSTANT = 0.95
MODES = 6
ROUNDS = 4
# The outer part is defined by the distance from the region's border. Deep inside, a colour that differs from the chosen one may be the background.
RIM = 0.4
# Largest log-ratio of the histograms, whose tails are unreliable.
STRONGEST = 1.5
# Standard deviation (grey levels) of a colour about the expected one, and the largest penalty for the difference (m above).
EXPECTED_SD, EXPECTED_MOST = 30.0, 1.5


class BackgroundFrames(NamedTuple):
    """Where each frame shows the background; and where the background is doubtful because the chosen colour is one of the person's."""

    frames: Bool[np.ndarray, "frame row column"]
    doubtful: Bool[np.ndarray, "row column"]


def background_frames(stack: Stack) -> BackgroundFrames:
    """Decide it from small images with equalised exposure, in temporal order."""
    colour = most_frequent(stack)
    changing = _filled(_alike(stack, colour).mean(axis=0) < CONSTANT)
    doubtful = np.zeros_like(changing)
    if changing.any() and not changing.all():
        colour, doubtful = _choose(stack, colour, changing)
    return BackgroundFrames(_alike(stack, colour), doubtful)


def most_frequent(stack: Stack) -> Float[np.ndarray, "row column 3"]:
    """The mean of the heaviest Gaussian of each pixel's mixture; all frames have equal weight."""
    mixture = cv2.createBackgroundSubtractorMOG2(len(stack), detectShadows=False)
    for count, image in enumerate(stack, 1):
        mixture.apply(image, learningRate=1 / count)
    # The background image is the mean of the heaviest Gaussians that together reach this share of the weight.
    mixture.setBackgroundRatio(1e-6)
    return mixture.getBackgroundImage().astype(np.float32)


def _alike(stack: Stack, colour: NDArray[np.float32]) -> NDArray[np.bool_]:
    return np.stack([squared_length(image - colour) < SAME_COLOUR**2 for image in stack])


def _filled(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The mask with its holes filled: where the person is always in front, the colour is constant but enclosed by changing pixels."""
    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(np.zeros(mask.shape, np.uint8), outlines, -1, 1, cv2.FILLED) > 0


def _choose(stack: Stack, colour: NDArray[np.float32], changing: NDArray[np.bool_]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """The background's colours, (row, column, 3), and where they are doubtful."""
    bins, samples = colour_bins(stack), stack[:, changing].astype(np.float32)
    centres, members = _modes(samples)
    unexpected = squared_length(centres - _expected(colour, changing)[changing]) / (2 * EXPECTED_SD**2)
    belief = np.exp(-np.minimum(unexpected, EXPECTED_MOST))
    depth = cv2.distanceTransform(changing.astype(np.uint8), cv2.DIST_L2, 3)[changing]
    rim = depth < RIM * depth.max()
    scene, person = colour_histogram(bins[:, ~changing], 3), colour_histogram(bins[:, changing], 3)
    chosen, colour = centres[0], colour.copy()
    for _ in range(ROUNDS):
        ratio = np.clip(np.log(scene / person), -STRONGEST, STRONGEST).astype(np.float32)
        weights = np.exp(np.stack([cv2.blur(ratio[indices], (3, 3)) for indices in bins])[:, changing])
        heaviest = np.argmax(belief * [(weights * (members == mode)).sum(axis=0) for mode in range(MODES)], axis=0)
        chosen = centres[heaviest, np.arange(centres.shape[1])]
        outliers = rim & (squared_length(samples - chosen) >= SAME_COLOUR**2)
        if not outliers.any():
            break
        person = colour_histogram(bins[:, changing][outliers], 3)
    colour[changing] = chosen
    return colour, changing & (person > scene)[colour_bins(colour.astype(np.uint8))]


def _expected(colour: NDArray[np.float32], changing: NDArray[np.bool_]) -> NDArray[np.float32]:
    dilated_mask = cv2.dilate(changing.astype(np.uint8), np.ones((3, 3), np.uint8))
    return cv2.inpaint(colour.astype(np.uint8), dilated_mask, 3, cv2.INPAINT_TELEA).astype(np.float32)


def _modes(samples: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.int8]]:
    """The colours of each pixel of (frame, pixel, 3) as (mode, pixel, 3), and each sample's mode, (frame, pixel); -1: a mode that was replaced."""
    frames, pixels, _ = samples.shape
    centres, counts = np.full((MODES, pixels, 3), 1e4, np.float32), np.zeros((MODES, pixels), np.float32)
    members, every = np.full((frames, pixels), -1, np.int8), np.arange(pixels)
    for frame, values in enumerate(samples):
        distance = squared_length(centres - values)
        mode = distance.argmin(axis=0)
        # A new colour replaces the one that was seen least.
        new = np.flatnonzero(distance[mode, every] > SAME_MODE**2)
        mode[new] = counts[:, new].argmin(axis=0)
        members[:frame, new] = np.where(members[:frame, new] == mode[new], -1, members[:frame, new])
        centres[mode[new], new], counts[mode[new], new] = values[new], 0
        counts[mode, every] += 1
        centres[mode, every] += (values - centres[mode, every]) / counts[mode, every][:, None]
        members[frame] = mode
    return centres, members


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
    masks = [cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)[..., None] > 0 for mask in shown.frames]
    colours = [_channels(image) for image in images]
    first, _ = _moments(colours, masks)
    # Small images mix neighbouring pixels: at edges, some pixels that they call background are not.
    agreeing = [mask & (squared_length(image - first)[..., None] < (1.5 * SAME_COLOUR) ** 2) for image, mask in zip(colours, masks, strict=True)]
    mean, sd = _moments(colours, agreeing, first)
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
    images: Sequence[NDArray[np.uint8]], masks: Sequence[NDArray[np.bool_]], otherwise: NDArray[np.float32] | None = None
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Mean and standard deviation over the images in which a pixel counts. A pixel that never counts gets `otherwise` and an unknown deviation."""
    count = np.zeros((*images[0].shape[:2], 1), np.float32)
    total, squares = np.zeros(images[0].shape, np.float32), np.zeros(images[0].shape, np.float32)
    for image, mask in zip(images, masks, strict=True):
        values = image * mask.astype(np.float32)
        count += mask
        total += values
        squares += values * values
    mean = total / np.maximum(count, 1)
    sd = np.sqrt(np.maximum(squares / np.maximum(count, 1) - mean**2, 0))
    if otherwise is not None:
        mean = np.where(count > 0, mean, otherwise)
    return mean.astype(np.float32), np.where(count > 1, sd, UNKNOWN_SD).astype(np.float32)
