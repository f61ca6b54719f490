r"""Which frames show the background, pixel by pixel, where a person may stand at one place for most of a recording.

OpenCV's Gaussian mixture gives each pixel's most frequent colour. That is the background wherever it is seen most of the time; where a person stays,
it is the person. At pixels whose colour changes, and at what they enclose, the choice between the colours k that were seen, each at times $T_k$ and
with the mean $c_k$, is therefore

$$\operatorname*{argmax}_k \; e^{-\min(\|c_k - \bar c\|^2 / 2\sigma^2,\, m)}
  \sum_{t \in T_k} \frac{p(I_t \mid \text{scene})}{p(I_t \mid \text{person})},$$

with the colour $\bar c$ that is expected from the constant pixels around (OpenCV's inpainting), and the two densities as histograms of colours: of
the pixels that never change, and of those samples, in the outer part of what changes, that differ from the background chosen so far (to begin with,
of all samples of changing pixels).
A colour that is common in the scene and rare on the person wins even if it was seen for a tenth of the time. What is never seen cannot be learned:
such pixels keep a colour of the person's and are marked as doubtful.

All of it is a function of the frames: the same frames give the same background.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy.typing import NDArray

from bayes_body.observation.colours import colour_bins, colour_histogram

type Stack = UInt8[np.ndarray, "frame row column 3"]

# Distance in colour, grey levels, within which a value is a pixel's background; and within which it joins the colours seen before.
SAME_COLOUR, SAME_MODE = 18.0, 10.0
# A pixel that has one colour for this share of the time does not change.
CONSTANT = 0.95
MODES = 6
ROUNDS = 4
# The outer part of what changes, by the distance from its border: deep inside, what differs from the background chosen may be the background.
RIM = 0.4
# Logarithm of the histograms' ratio, at most: they know their tails badly.
STRONGEST = 1.5
# Standard deviation (grey levels) of a colour about what is expected from its surroundings, and the most that this counts (m above).
EXPECTED_SD, EXPECTED_MOST = 30.0, 1.5


class Shown(NamedTuple):
    """Where each frame shows the background; and where the background is in doubt, for what was taken for it has a colour of the person's."""

    frames: Bool[np.ndarray, "frame row column"]
    doubtful: Bool[np.ndarray, "row column"]


def background_frames(stack: Stack) -> Shown:
    """Of small images, evenly exposed, in the order of time."""
    colour = most_frequent(stack)
    changing = _filled(_alike(stack, colour).mean(axis=0) < CONSTANT)
    doubtful = np.zeros_like(changing)
    if changing.any() and not changing.all():
        colour, doubtful = _choose(stack, colour, changing)
    return Shown(_alike(stack, colour), doubtful)


def most_frequent(stack: Stack) -> Float[np.ndarray, "row column 3"]:
    """The mean of the heaviest Gaussian of each pixel's mixture, every frame counting equally."""
    mixture = cv2.createBackgroundSubtractorMOG2(len(stack), detectShadows=False)
    for count, image in enumerate(stack, 1):
        mixture.apply(image, learningRate=1 / count)
    # The image is the mean of as many Gaussians as reach this share of the weight.
    mixture.setBackgroundRatio(1e-6)
    return mixture.getBackgroundImage().astype(np.float32)


def _alike(stack: Stack, colour: NDArray[np.float32]) -> NDArray[np.bool_]:
    return np.stack([((image - colour) ** 2).sum(axis=-1) < SAME_COLOUR**2 for image in stack])


def _filled(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """With its holes: what is never seen for the person is constant, too, but lies within what changes."""
    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(np.zeros(mask.shape, np.uint8), outlines, -1, 1, cv2.FILLED) > 0


def _choose(stack: Stack, colour: NDArray[np.float32], changing: NDArray[np.bool_]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """The background's colours, (row, column, 3), and where they are in doubt."""
    bins, samples = colour_bins(stack), stack[:, changing].astype(np.float32)
    centres, members = _modes(samples)
    unexpected = ((centres - _expected(colour, changing)[changing]) ** 2).sum(axis=-1) / (2 * EXPECTED_SD**2)
    belief = np.exp(-np.minimum(unexpected, EXPECTED_MOST))
    depth = cv2.distanceTransform(changing.astype(np.uint8), cv2.DIST_L2, 3)[changing]
    rim = depth < RIM * depth.max()
    scene, person = colour_histogram(bins[:, ~changing], 3), colour_histogram(bins[:, changing], 3)
    chosen, colour = centres[0], colour.copy()
    for _ in range(ROUNDS):
        ratio = np.clip(np.log(scene / person), -STRONGEST, STRONGEST).astype(np.float32)
        weights = np.exp(np.stack([cv2.blur(ratio[each], (3, 3)) for each in bins])[:, changing])
        heaviest = np.argmax(belief * [(weights * (members == mode)).sum(axis=0) for mode in range(MODES)], axis=0)
        chosen = centres[heaviest, np.arange(centres.shape[1])]
        away = rim & (((samples - chosen) ** 2).sum(axis=-1) >= SAME_COLOUR**2)
        if not away.any():
            break
        person = colour_histogram(bins[:, changing][away], 3)
    colour[changing] = chosen
    return colour, changing & (person > scene)[colour_bins(colour.astype(np.uint8))]


def _expected(colour: NDArray[np.float32], changing: NDArray[np.bool_]) -> NDArray[np.float32]:
    around = cv2.dilate(changing.astype(np.uint8), np.ones((3, 3), np.uint8))
    return cv2.inpaint(colour.astype(np.uint8), around, 3, cv2.INPAINT_TELEA).astype(np.float32)


def _modes(samples: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.int8]]:
    """The colours that each pixel of (frame, pixel, 3) had, (mode, pixel, 3), and each sample's, (frame, pixel), -1: of one forgotten since."""
    frames, pixels, _ = samples.shape
    centres, counts = np.full((MODES, pixels, 3), 1e4, np.float32), np.zeros((MODES, pixels), np.float32)
    members, every = np.full((frames, pixels), -1, np.int8), np.arange(pixels)
    for frame, values in enumerate(samples):
        distance = ((centres - values) ** 2).sum(axis=-1)
        mode = distance.argmin(axis=0)
        # A colour of its own takes the place of the one that was seen least.
        new = np.flatnonzero(distance[mode, every] > SAME_MODE**2)
        mode[new] = counts[:, new].argmin(axis=0)
        members[:frame, new] = np.where(members[:frame, new] == mode[new], -1, members[:frame, new])
        centres[mode[new], new], counts[mode[new], new] = values[new], 0
        counts[mode, every] += 1
        centres[mode, every] += (values - centres[mode, every]) / counts[mode, every][:, None]
        members[frame] = mode
    return centres, members
