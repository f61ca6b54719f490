"""Posterior predictive check of keypoints: the pixels that draws of the pose and of the likelihood's noise predict, against those that were seen.

With z the seen pixels, s a draw of the pose and z' a draw of the keypoints given s, the predictive distribution is that of z' over both
(Gelman, Meng & Stern 1996). The error of a keypoint is its distance from the mean of the pixels that the draws expect.
"""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, Shaped

from bayes_body.base.shapes import Key
from bayes_body.model.build import Model
from bayes_body.model.likelihood.detections import Detections
from bayes_body.model.likelihood.markers_gaussian import MarkersGaussian

# Draws of the noise for each draw of the pose.
NOISES = 5
ENDS = (0.05, 0.95)
# Percentiles of errors.
SHOWN = (50, 90)


class KeypointCheck(NamedTuple):
    """The comparison of one frame's keypoints; pixels.

    Attributes:
        error: distance of each seen keypoint from the mean of the pixels that the draws expect; NaN where it is not seen.
        expected: median and 90 % quantile of the same distance of predicted keypoints, over the seen markers; NaN for a camera without any.
        inside: share of a keypoint's two coordinates inside their 90 % predictive intervals; NaN where it is not seen.
    """

    error: Float[np.ndarray, "camera marker"]
    expected: Float[np.ndarray, "camera share"]
    inside: Float[np.ndarray, "camera marker"]


def marker_likelihood(model: Model) -> tuple[str, MarkersGaussian] | None:
    """Return the name of the model's likelihood of keypoints and its distribution; None if the model has none."""
    for factor in model.factors:
        for part in getattr(factor.simulate, "args", ()):
            if isinstance(part, MarkersGaussian):
                return factor.name, part
    return None


def noise_in_words(detections: Detections) -> str:
    """Return for example `Gaussian with a standard deviation of 8 px in each coordinate`."""
    low, high = float(detections.sd_px.min()), float(detections.sd_px.max())
    width = f"{low:.3g} px" if high - low < 0.01 * high else f"{low:.3g} to {high:.3g} px by camera"
    named = f"Gaussian with a standard deviation of {width} in each coordinate"
    if detections.noise == "student":
        named = f"Student's t with {float(detections.degrees_of_freedom):g} degrees of freedom and a scale of {width}"
    confident = ", divided by a power of the confidence" if detections.by_confidence else ""
    return f"{named}{confident}{f', and {100 * detections.outliers:g} % outliers' if detections.outliers else ''}"


def keypoint_check(
    detections: Detections, points: Float[np.ndarray, "draw marker 3"], keypoints: Float[np.ndarray, "camera marker 3"], key: Key
) -> KeypointCheck:
    """Compare a frame's keypoints with their predictive distribution.

    Args:
        detections: the distribution of the keypoints in the likelihood.
        points: the markers of each draw of the pose, metres.
        keypoints: column, row and confidence of the keypoints.
        key: random key of the noise.
    """
    present = keypoints[..., 2] > float(detections.least_confidence)
    middle = expected_pixels(detections, points).mean(axis=0)
    drawn = predicted_pixels(detections, points, np.where(present, keypoints[..., 2], 1.0), key)
    # With this definition of the quantile, a new draw from the same distribution is inside with probability 0.9, however few draws there are.
    low, high = np.quantile(drawn, ENDS, axis=0, method="weibull")
    inside = ((low <= keypoints[..., :2]) & (keypoints[..., :2] <= high)).mean(axis=-1)
    far = np.linalg.norm(drawn - middle, axis=-1)
    expected = np.array([np.percentile(far[:, c, mask], SHOWN) if mask.any() else (np.nan, np.nan) for c, mask in enumerate(present)])
    error = np.linalg.norm(keypoints[..., :2] - middle, axis=-1)
    return KeypointCheck(np.where(present, error, np.nan), expected, np.where(present, inside, np.nan))


def expected_pixels(detections: Detections, points: Float[np.ndarray, "draw marker 3"]) -> Float[np.ndarray, "draw camera marker 2"]:
    """Return the pixels at which each draw expects the markers, without noise."""
    return np.asarray(_expected(detections, points))


def predicted_pixels(
    detections: Detections,
    points: Float[np.ndarray, "draw marker 3"],
    confidence: Float[np.ndarray, "camera marker"],
    key: Key,
) -> Float[np.ndarray, "drawn camera marker 2"]:
    """Return NOISES draws of the keypoints for each draw of the pose; the first noise of all draws comes first."""
    keys = jax.random.split(key, (NOISES, len(points)))
    drawn = np.asarray(_drawn(detections, keys, points, confidence))
    return drawn.reshape(-1, *drawn.shape[2:])


@jax.jit
def _expected(detections: Detections, points: Float[Array, "draw marker 3"]) -> Float[Array, "draw camera marker 2"]:
    return jax.vmap(detections.expected)(points)


@jax.jit
def _drawn(
    detections: Detections, keys: Shaped[PRNGKeyArray, "noise draw"], points: Float[Array, "draw marker 3"], confidence: Float[Array, "camera marker"]
) -> Float[Array, "noise draw camera marker 2"]:
    by_pose = jax.vmap(detections.draw, (0, 0, None))
    return jax.vmap(by_pose, (0, None, None))(keys, points, confidence)
