r"""How likely each pixel is foreground, given the camera's background.

The background's colour is Gaussian about its mean, $N(\mu, \Sigma)$, and the foreground's is uniform over all $V$ colours. With a prior share $\pi$
of foreground Bayes' rule gives

$$\frac{p}{1-p} = \frac{\pi / V}{(1-\pi)\, |2\pi\Sigma|^{-1/2} e^{-d^2/2}} \quad\Longrightarrow\quad p = \frac{1}{1 + e^{-(d^2 - \theta)/2}},
\qquad \theta = 2 \ln \frac{(1-\pi) V}{\pi\, |2\pi\Sigma|^{1/2}},$$

$d^2 = (I-\mu)^T \Sigma^{-1} (I-\mu)$, where each channel counts by itself: $\Sigma$ is diagonal. The threshold $\theta$ is an option
(`segmentation.threshold`): a standard deviation of 5 in each of three channels and $\pi = 1/2$ give 18.

Exposure: the background is first brought to the image's (observation/exposure.py), with values cut off where an image cuts them off. Shadows: as in
OpenCV's mixture, a pixel may be the background darkened by any factor a of [1/2, 1], so that its distance is the least over a; grey cameras show
nothing by which a shadow could be told from a dark thing, and have none. What is left is cleaned of specks.
"""

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy.typing import NDArray

from bayes_body.observation.background import Background, shrink
from bayes_body.observation.exposure import fit_exposure
from bayes_body.observation.pictures import Colours
from bayes_body.session import Segmentation

DARKEST_SHADOW = 0.5
# At the size worked on: a speck is smaller than this many pixels, or than this share of the largest piece.
LEAST_PIXELS, LEAST_SHARE = 30, 0.02
# Levels of the foreground's probability, of 255.
EVEN, ENCLOSED = 127, 191
SATURATED = 250
# Pixels at the size worked on: gaps in a silhouette's outline up to this width still enclose.
BRIDGED = 21


def foreground_levels(background: Background, image: Colours, options: Segmentation) -> UInt8[np.ndarray, "row column"] | None:
    """The foreground's probability times 255, of the image's size; None if the image cannot be brought to the background's exposure."""
    small = shrink(image)[..., : background.mean.shape[-1]]
    expected, sd = background.mean, background.sd
    if options.follow_exposure:
        exposure = fit_exposure(small, background.mean)
        if exposure is None:
            return None
        expected, sd = np.clip(expected * exposure.gain + exposure.offset, 0, 255), sd * exposure.gain
    distance = _distance(small, expected, sd, background.mean >= SATURATED)
    if options.shadows and small.shape[-1] == 3:
        _forgive_shadows(distance, small, expected, sd, options.threshold)
    levels = np.rint(255 / (1 + np.exp(np.clip((options.threshold - distance) / 2, -30, 30)))).astype(np.uint8)
    levels = _clean(np.asarray(cv2.medianBlur(levels, 3), np.uint8), background.doubtful)
    height, width = image.shape[:2]
    return np.asarray(cv2.resize(levels, (width, height), interpolation=cv2.INTER_LINEAR), np.uint8)


def _distance(image: NDArray[np.uint8], expected: NDArray[np.float32], sd: NDArray[np.float32], saturated: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Squared Mahalanobis distance, (row, column)."""
    off = (image - expected) / sd
    # Where the background is as bright as can be, only what is darker differs from it.
    off[saturated & (off > 0)] = 0
    return np.einsum("ijc,ijc->ij", off, off)


def _forgive_shadows(
    distance: NDArray[np.float32], image: NDArray[np.uint8], expected: NDArray[np.float32], sd: NDArray[np.float32], threshold: float
) -> None:
    """Put the distance from the darkened background where it is less (in place); only pixels that are otherwise likely foreground are looked at."""
    likely = np.flatnonzero(distance > threshold / 2)
    values, lit, deviation = (np.take(a.reshape(-1, a.shape[-1]), likely, axis=0) for a in (image, expected, sd))
    values, lit = values / deviation, lit / deviation
    factor = np.einsum("pc,pc->p", values, lit) / np.maximum(np.einsum("pc,pc->p", lit, lit), 1e-6)
    factor = np.clip(factor, DARKEST_SHADOW, 1)
    off = values - factor[:, None] * lit
    distance.reshape(-1)[likely] = np.minimum(distance.reshape(-1)[likely], np.einsum("pc,pc->p", off, off) / factor**2)


def _clean(levels: NDArray[np.uint8], doubtful: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Without specks, and with those holes filled whose background is in doubt: there the person may have been learned as background."""
    mask = (levels > EVEN).astype(np.uint8)
    _, pieces, figures, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    areas = figures[:, cv2.CC_STAT_AREA]
    least = max(LEAST_PIXELS, LEAST_SHARE * areas[1:].max(initial=0))
    small = areas < least
    small[0] = False
    levels = np.where(small[np.asarray(pieces, np.intp)], 0, levels).astype(np.uint8)
    if doubtful.any():
        bridge = np.ones((BRIDGED, BRIDGED), np.uint8)
        closed = cv2.morphologyEx((levels > EVEN).astype(np.uint8), cv2.MORPH_CLOSE, bridge)
        outlines, _ = cv2.findContours(closed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        inside = cv2.drawContours(np.zeros_like(levels), outlines, -1, 1, cv2.FILLED) > 0
        levels[inside & doubtful & (levels < ENCLOSED)] = ENCLOSED
    return levels
