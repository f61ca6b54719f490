r"""The probability of foreground for each pixel, given the camera's background.

The background's colour is Gaussian about its mean, $N(\mu, \Sigma)$. The foreground's is, at first, uniform over all $V$ colours. With a prior
probability $\pi$ of foreground, Bayes' rule gives

$$\frac{p}{1-p} = \frac{\pi / V}{(1-\pi)\, |2\pi\Sigma|^{-1/2} e^{-d^2/2}} \quad\Longrightarrow\quad p = \frac{1}{1 + e^{-(d^2 - \theta)/2}},
\qquad \theta = 2 \ln \frac{(1-\pi) V}{\pi\, |2\pi\Sigma|^{1/2}},$$

$d^2 = (I-\mu)^T \Sigma^{-1} (I-\mu)$. The channels are independent: $\Sigma$ is diagonal. The threshold $\theta$ is an option
(`segmentation.threshold`): a standard deviation of 5 in each of three channels and $\pi = 1/2$ give 18.

Exposure: the background is first matched to the image's exposure (recording/observation/exposure.py), and clipped where the image is. Shadows: as in
OpenCV's mixture, a pixel may be the background darkened by any factor a in [1/2, 1], so its distance is the minimum over a. In a grey image a shadow
looks like a dark object, so grey cameras have no shadows.

Two kinds of context improve uncertain pixels. First, the colours $h(I)$ of the certain foreground are the person's: the foreground's density
becomes $u / V + (1-u)\, h(I)$. Second, neighbours tend to be alike: from the log-odds $x^0$ of each pixel by itself, the mean-field approximation of
an Ising field gives

$$x \leftarrow x^0 + c\, G * \tanh(x / 2),$$

with $G$ a Gaussian over the neighbours. Finally, specks are removed. Everything is computed from this one image.
"""

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy.typing import NDArray

from bayes_body.recording.observation.background import Background
from bayes_body.recording.observation.exposure import Exposure, colour_bins, colour_histogram, fit_exposure, squared_length
from bayes_body.recording.observation.pictures import Colours
from bayes_body.recording.session.session import Segmentation

type LogOdds = Float[np.ndarray, "row column"]

DARKEST_SHADOW = 0.5
# At the working size: a speck has fewer pixels than this, or than this share of the largest component.
LEAST_PIXELS, LEAST_SHARE = 30, 0.02
# Levels of the foreground's probability, out of 255.
EVEN, ENCLOSED, CERTAIN = 127, 191, 200
# Log-odds are clipped here, for float32's sake.
SURE = 30.0
# The person's colours: the least number of pixels, and u, the share of colours that the certain pixels do not show.
LEAST_SURE, UNSEEN = 200, 0.5
# They affect pixels within this distance of the certain ones.
NEAR = 16
# Neighbours: strength c and standard deviation (pixels) of the coupling, and number of iterations.
COUPLING, REACH, ROUNDS = 4.0, 2.0, 5
SATURATED = 250
# Pixels at the working size: an outline with gaps up to this width still encloses its interior.
BRIDGED = 21
# Rows of an image that are computed together: their arrays fit into a core's cache.
STRIP = 32


def foreground_levels(background: Background, image: Colours, options: Segmentation) -> UInt8[np.ndarray, "row column"] | None:
    """The foreground's probability times 255 in an image of the background's size (`background.py`: `shrink`).

    None if the image's exposure cannot be matched to the background's.
    """
    small = image[..., : background.mean.shape[-1]]
    independent = independent_log_odds(background, small, options)
    if independent is None:
        return None
    log_odds = _among_neighbours(independent + _by_the_persons_colours(small, independent))
    return _clean(np.asarray(cv2.medianBlur(_levels(log_odds), 3), np.uint8), background.doubtful)


def independent_log_odds(background: Background, small: UInt8[np.ndarray, "row column channel"], options: Segmentation) -> LogOdds | None:
    """ln p / (1 - p) of each pixel by itself, with a uniform foreground; None as above.

    Args:
        background: the camera's background.
        small: the image in the background's size and channels.
        options: the session's options.
    """
    exposure = fit_exposure(small, background.mean) if options.follow_exposure else None
    if options.follow_exposure and exposure is None:
        return None
    distance = np.empty(small.shape[:2], np.float32)
    for first in range(0, len(small), STRIP):
        rows = slice(first, first + STRIP)
        expected, sd = _exposed(background, exposure, rows)
        distance[rows] = _distance(small[rows], expected, sd, background.mean[rows])
    if options.shadows and small.shape[-1] == 3:
        _forgive_shadows(distance, small, background, exposure, options.threshold)
    distance -= np.float32(options.threshold)
    distance *= np.float32(0.5)
    return np.clip(distance, -SURE, SURE, out=distance)


def _exposed(background: Background, exposure: Exposure | None, rows: slice) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Mean and standard deviation of some rows of the background at an image's exposure; None: at its own."""
    mean, sd = background.mean[rows], background.sd[rows]
    if exposure is None:
        return mean, sd
    # A gain for each value of a row: NumPy is slow where an axis of three is multiplied by three numbers.
    gain = np.tile(exposure.gain, mean.shape[1])
    expected = _flat(mean) * gain
    expected += _flat(exposure.offset[rows])
    np.clip(expected, 0, 255, out=expected)
    return expected.reshape(mean.shape), (_flat(sd) * gain).reshape(sd.shape)


def _flat(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """(row, column, channel) as (row, value)."""
    return values.reshape(len(values), -1)


def _distance(image: NDArray[np.uint8], expected: NDArray[np.float32], sd: NDArray[np.float32], mean: NDArray[np.float32]) -> NDArray[np.float32]:
    """Squared Mahalanobis distance, (row, column)."""
    off = image - expected
    off /= sd
    # Where the background is saturated, only darker values differ from it.
    saturated = mean >= SATURATED
    if saturated.any():
        off[saturated & (off > 0)] = 0
    return squared_length(off)


def _forgive_shadows(
    distance: NDArray[np.float32], image: NDArray[np.uint8], background: Background, exposure: Exposure | None, threshold: float
) -> None:
    """Use the distance from the darkened background where it is smaller (in place). Only pixels that are otherwise likely foreground are examined."""
    likely = np.flatnonzero(distance > threshold / 2)
    values, lit, deviation = (np.take(a.reshape(-1, 3), likely, axis=0) for a in (image, background.mean, background.sd))
    if exposure is not None:
        lit = np.clip(lit * exposure.gain + np.take(exposure.offset.reshape(-1, 3), likely, axis=0), 0, 255)
        deviation = deviation * exposure.gain
    values, lit = values / deviation, lit / deviation
    factor = np.einsum("pc,pc->p", values, lit) / np.maximum(np.einsum("pc,pc->p", lit, lit), 1e-6)
    factor = np.clip(factor, DARKEST_SHADOW, 1)
    off = values - factor[:, None] * lit
    distance.reshape(-1)[likely] = np.minimum(distance.reshape(-1)[likely], np.einsum("pc,pc->p", off, off) / factor**2)


def _levels(log_odds: LogOdds) -> NDArray[np.uint8]:
    odds = np.clip(log_odds, -SURE, SURE)
    np.negative(odds, out=odds)
    np.exp(odds, out=odds)
    odds += 1
    np.divide(255, odds, out=odds)
    return np.rint(odds, out=odds).astype(np.uint8)


def _by_the_persons_colours(image: NDArray[np.uint8], log_odds: LogOdds) -> LogOdds:
    """The change of the log-odds when the colours of the certain foreground replace the uniform distribution.

    It is 0 if too few pixels are certain, and far from the certain ones: a tree may have the colours of a coat.
    """
    sure = (_without_specks(_levels(log_odds)) > CERTAIN).astype(np.uint8)
    added = np.zeros_like(log_odds)
    # Nothing further away is near: even along a row, where OpenCV's distance is a little too short.
    box = _box(sure, NEAR + 2)
    sure, image = sure[box], image[box]
    # At its edge the person's colours mix with the background's.
    core = cv2.erode(sure, np.ones((3, 3), np.uint8)) > 0
    if core.sum() < LEAST_SURE:
        return added
    is_near = cv2.distanceTransform(1 - sure, cv2.DIST_L2, 3) < NEAR
    bins = colour_bins(image)
    shares = colour_histogram(bins[core], image.shape[-1])
    log_ratios = np.log(UNSEEN + (1 - UNSEEN) * shares * shares.size).astype(np.float32)
    added[box][is_near] = log_ratios[bins[is_near]]
    return added


def _box(mask: NDArray[np.uint8], margin: int) -> tuple[slice, slice]:
    """The rows and columns of a mask's smallest box with a margin."""
    column, row, width, height = cv2.boundingRect(mask)
    return slice(max(row - margin, 0), row + height + margin), slice(max(column - margin, 0), column + width + margin)


def _among_neighbours(independent: LogOdds) -> LogOdds:
    log_odds, neighbours = independent.copy(), np.empty_like(independent)
    for _ in range(ROUNDS):
        log_odds *= np.float32(0.5)
        np.tanh(log_odds, out=log_odds)
        cv2.GaussianBlur(log_odds, (0, 0), REACH, dst=neighbours)
        neighbours *= np.float32(COUPLING)
        np.add(independent, neighbours, out=log_odds)
    return log_odds


def _clean(levels: NDArray[np.uint8], doubtful: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Remove specks, and fill holes where the background is doubtful: there the person may have been learned as background."""
    levels = _without_specks(levels)
    if doubtful.any():
        bridge = np.ones((BRIDGED, BRIDGED), np.uint8)
        closed = cv2.morphologyEx((levels > EVEN).astype(np.uint8), cv2.MORPH_CLOSE, bridge)
        outlines, _ = cv2.findContours(closed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        inside = cv2.drawContours(np.zeros_like(levels), outlines, -1, 1, cv2.FILLED) > 0
        levels[inside & doubtful & (levels < ENCLOSED)] = ENCLOSED
    return levels


def _without_specks(levels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    mask = levels > EVEN
    foreground = np.flatnonzero(mask)
    # Labels of 16 bits are faster, and enough for a piece a pixel.
    label_type = cv2.CV_16U if foreground.size < 1 << 16 else cv2.CV_32S
    _, labels = cv2.connectedComponents(mask.view(np.uint8), connectivity=8, ltype=label_type)
    pieces = np.asarray(labels).reshape(-1)[foreground].astype(np.intp)
    areas = np.bincount(pieces)
    least = max(LEAST_PIXELS, LEAST_SHARE * areas.max(initial=0))
    cleaned = levels.copy()
    cleaned.reshape(-1)[foreground[(areas < least)[pieces]]] = 0
    return cleaned
