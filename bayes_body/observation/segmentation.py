r"""How likely each pixel is foreground, given the camera's background.

The background's colour is Gaussian about its mean, $N(\mu, \Sigma)$, and the foreground's, to begin with, is uniform over all $V$ colours. With a
prior share $\pi$ of foreground Bayes' rule gives

$$\frac{p}{1-p} = \frac{\pi / V}{(1-\pi)\, |2\pi\Sigma|^{-1/2} e^{-d^2/2}} \quad\Longrightarrow\quad p = \frac{1}{1 + e^{-(d^2 - \theta)/2}},
\qquad \theta = 2 \ln \frac{(1-\pi) V}{\pi\, |2\pi\Sigma|^{1/2}},$$

$d^2 = (I-\mu)^T \Sigma^{-1} (I-\mu)$, where each channel counts by itself: $\Sigma$ is diagonal. The threshold $\theta$ is an option
(`segmentation.threshold`): a standard deviation of 5 in each of three channels and $\pi = 1/2$ give 18.

Exposure: the background is first brought to the image's (observation/exposure.py), with values cut off where an image cuts them off. Shadows: as in
OpenCV's mixture, a pixel may be the background darkened by any factor a of [1/2, 1], so that its distance is the least over a; grey cameras show
nothing by which a shadow could be told from a dark thing, and have none.

What is almost sure tells of what is not, in two ways. The colours of the sure foreground, $h(I)$, are the person's: the foreground's density becomes
$u / V + (1-u)\, h(I)$. And a pixel is what its neighbours are: with the log-odds $x^0$ of each alone, those of a field with Ising's coupling are, in
the mean-field approximation,

$$x \leftarrow x^0 + c\, G * \tanh(x / 2),$$

$G$ a Gaussian over the neighbours. What is left is cleaned of specks. All of it is made of this one image.
"""

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy.typing import NDArray

from bayes_body.observation.background import Background, shrink
from bayes_body.observation.colours import colour_bins, colour_histogram
from bayes_body.observation.exposure import fit_exposure
from bayes_body.observation.pictures import Colours
from bayes_body.session.session import Segmentation

type LogOdds = Float[np.ndarray, "row column"]

DARKEST_SHADOW = 0.5
# At the size worked on: a speck is smaller than this many pixels, or than this share of the largest piece.
LEAST_PIXELS, LEAST_SHARE = 30, 0.02
# Levels of the foreground's probability, of 255.
EVEN, ENCLOSED, CERTAIN = 127, 191, 200
# Log-odds beyond which nothing is surer, for float32's sake.
SURE = 30.0
# The person's colours: from so many pixels at least, and u, the share of those that the sure ones do not show.
LEAST_SURE, UNSEEN = 200, 0.5
# They say something of pixels within this distance of the sure ones.
NEAR = 16
# The neighbours: the strength c and the standard deviation of their coupling, pixels, and how often the field is gone through.
COUPLING, REACH, ROUNDS = 4.0, 2.0, 5
SATURATED = 250
# Pixels at the size worked on: gaps in a silhouette's outline up to this width still enclose.
BRIDGED = 21


def foreground_levels(background: Background, image: Colours, options: Segmentation) -> UInt8[np.ndarray, "row column"] | None:
    """The foreground's probability times 255, of the image's size; None if the image cannot be brought to the background's exposure."""
    small = shrink(image)[..., : background.mean.shape[-1]]
    alone = log_odds_alone(background, small, options)
    if alone is None:
        return None
    log_odds = _among_neighbours(alone + _by_the_persons_colours(small, alone))
    levels = _clean(np.asarray(cv2.medianBlur(_levels(log_odds), 3), np.uint8), background.doubtful)
    height, width = image.shape[:2]
    return np.asarray(cv2.resize(levels, (width, height), interpolation=cv2.INTER_LINEAR), np.uint8)


def log_odds_alone(background: Background, small: UInt8[np.ndarray, "row column channel"], options: Segmentation) -> LogOdds | None:
    """ln p / (1 - p) of each pixel by itself, against a foreground of all colours; None as above.

    Args:
        background: of the camera.
        small: the image at the background's size and with its channels.
        options: the session's.
    """
    expected, sd = background.mean, background.sd
    if options.follow_exposure:
        exposure = fit_exposure(small, background.mean)
        if exposure is None:
            return None
        expected, sd = np.clip(expected * exposure.gain + exposure.offset, 0, 255), sd * exposure.gain
    distance = _distance(small, expected, sd, background.mean >= SATURATED)
    if options.shadows and small.shape[-1] == 3:
        _forgive_shadows(distance, small, expected, sd, options.threshold)
    return np.clip((distance - options.threshold) / 2, -SURE, SURE).astype(np.float32)


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


def _levels(log_odds: LogOdds) -> NDArray[np.uint8]:
    return np.rint(255 / (1 + np.exp(-np.clip(log_odds, -SURE, SURE)))).astype(np.uint8)


def _by_the_persons_colours(image: NDArray[np.uint8], log_odds: LogOdds) -> LogOdds:
    """What is added to the log-odds where the colours of the sure foreground take the place of all colours.

    Nothing where too little is sure, and nothing far from it: a tree may have the colours of a coat.
    """
    sure = _without_specks(_levels(log_odds)) > CERTAIN
    # At its rim the person mixes with what is behind it.
    core = cv2.erode(sure.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    if core.sum() < LEAST_SURE:
        return np.zeros_like(log_odds)
    bins = colour_bins(image)
    shares = colour_histogram(bins[core], image.shape[-1])
    added = np.log(UNSEEN + (1 - UNSEEN) * shares * shares.size).astype(np.float32)[bins]
    return np.where(cv2.distanceTransform((~sure).astype(np.uint8), cv2.DIST_L2, 3) < NEAR, added, 0)


def _among_neighbours(alone: LogOdds) -> LogOdds:
    log_odds = alone
    for _ in range(ROUNDS):
        neighbours = cv2.GaussianBlur(np.tanh(log_odds / 2), (0, 0), REACH)
        log_odds = alone + np.asarray(COUPLING * neighbours, np.float32)
    return log_odds


def _clean(levels: NDArray[np.uint8], doubtful: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Without specks, and with those holes filled whose background is in doubt: there the person may have been learned as background."""
    levels = _without_specks(levels)
    if doubtful.any():
        bridge = np.ones((BRIDGED, BRIDGED), np.uint8)
        closed = cv2.morphologyEx((levels > EVEN).astype(np.uint8), cv2.MORPH_CLOSE, bridge)
        outlines, _ = cv2.findContours(closed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        inside = cv2.drawContours(np.zeros_like(levels), outlines, -1, 1, cv2.FILLED) > 0
        levels[inside & doubtful & (levels < ENCLOSED)] = ENCLOSED
    return levels


def _without_specks(levels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    mask = (levels > EVEN).astype(np.uint8)
    _, pieces, figures, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    areas = figures[:, cv2.CC_STAT_AREA]
    least = max(LEAST_PIXELS, LEAST_SHARE * areas[1:].max(initial=0))
    small = areas < least
    small[0] = False
    return np.where(small[np.asarray(pieces, np.intp)], 0, levels).astype(np.uint8)
