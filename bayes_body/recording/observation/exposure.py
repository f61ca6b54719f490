r"""Fit how much brighter or darker an image is than a reference, by trimmed least squares: for each colour channel

$$I(x, y) \approx g\,B(x, y) + \sum_{i+j \le 3} a_{ij}\, x^i y^j.$$

Automatic exposure and white balance change the gain g and a constant; veiling glare and flickering lamps add slowly varying terms. A person changes
some pixels abruptly. The fit is therefore iterated on the pixels that it already explains.

Smooth histograms give the densities of the colours of a scene or of a person.
"""

from functools import cache
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy.typing import NDArray

# About so many evenly spaced pixels are enough to fit eleven numbers per channel.
PIXELS = 4_000
ROUNDS = 4
DEGREE = 3
# Tolerances in grey levels: how far a pixel may be from a perfect fit.
LEAST_SPREAD = 2.0
# Values beyond these may be clipped and are not used.
DARKEST, BRIGHTEST = 4, 250
STRONGEST_GAIN = 3.0
# If fewer pixels are within `AGREEING` grey levels of the fit, the image shows something else, or nothing.
LEAST_SHARE, AGREEING = 0.5, 20.0
# Adds three channels.
SUM = np.ones((1, 3), np.float32)
# The slowly varying part is computed at so many points per side.
GRID = 16


class Exposure(NamedTuple):
    """image = gain * reference + offset; gain by channel, offset in grey levels by row, column and channel."""

    gain: Float[np.ndarray, " channel"]
    offset: Float[np.ndarray, "row column channel"]


def fit_exposure(image: UInt8[np.ndarray, "row column channel"], reference: Float[np.ndarray, "row column channel"]) -> Exposure | None:
    """The exposure that maps the reference to the image; None if none fits: another scene, a black or an overexposed image."""
    rows, columns, channels = image.shape
    stride = max(1, round(np.sqrt(rows * columns / PIXELS)))
    values, references = (a[::stride, ::stride].reshape(-1, channels).astype(np.float32) for a in (image, reference))
    terms = _terms(len(range(0, rows, stride)), len(range(0, columns, stride)))
    lines = np.array([_fit(references[:, c], values[:, c], terms) for c in range(channels)], np.float32)
    agrees = np.abs(values - np.clip(references * lines[:, 0] + terms @ lines[:, 1:].T, 0, 255)) < AGREEING
    is_inlier = np.logical_and.reduce(list(agrees.T))
    if is_inlier.mean() < LEAST_SHARE:
        return None
    field = (_terms(GRID, GRID) @ lines[:, 1:].T).reshape(GRID, GRID, channels)
    return Exposure(lines[:, 0], cv2.resize(field, (columns, rows), interpolation=cv2.INTER_LINEAR).reshape(rows, columns, channels))


def _median(values: NDArray[np.floating]) -> float:
    """The median, in the time of a partition: NumPy's looks for NaN too."""
    lower, upper = (values.size - 1) // 2, values.size // 2
    parts = np.partition(values, (lower, upper))
    # Their mean in their own precision.
    return float(parts[lower] if lower == upper else (parts[lower] + parts[upper]) / values.dtype.type(2))


@cache
def _terms(rows: int, columns: int) -> NDArray[np.float32]:
    """The monomials, (pixel, term), at evenly spaced points of an image with coordinates from -1 to 1."""
    x, y = np.meshgrid(*((np.arange(n) + 0.5) * 2 / n - 1 for n in (columns, rows)))
    return np.stack([(x**i * y**j).ravel() for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)], axis=1).astype(np.float32)


def _fit(x: NDArray[np.float32], y: NDArray[np.float32], terms: NDArray[np.float32]) -> NDArray[np.float32]:
    """Gain and polynomial coefficients; gain 1 and offset 0 if too few values are usable."""
    unchanged = np.eye(1, 1 + terms.shape[1], dtype=np.float32)[0]
    is_unclipped = (x > DARKEST) & (x < BRIGHTEST) & (y > DARKEST) & (y < BRIGHTEST)
    x, y, terms = x[is_unclipped], y[is_unclipped], np.compress(is_unclipped, terms, axis=0)
    if x.size < 10 * terms.shape[1]:
        return unchanged
    columns, brighter = np.column_stack([x, terms]), y - x
    residual = y - _median(y / x) * x
    line = unchanged
    for _ in range(ROUNDS):
        np.abs(residual, out=residual)
        is_inlier = residual <= max(2.5 * 1.4826 * _median(residual), LEAST_SPREAD)
        used = np.compress(is_inlier, columns, axis=0)
        # A weak prior (gain 1, offset 0) determines what an image of one colour leaves open.
        normal = used.T @ used + np.eye(used.shape[1], dtype=np.float32)
        line = unchanged + np.linalg.solve(normal, used.T @ brighter[is_inlier]).astype(np.float32)
        residual = y - columns @ line
    return line if 1 / STRONGEST_GAIN < line[0] < STRONGEST_GAIN else unchanged


def squared_length(differences: Float[np.ndarray, "row column channel"]) -> Float[np.ndarray, "row column"]:
    """The squared length of each pixel's difference of colours; the differences are overwritten."""
    differences *= differences
    # NumPy is slow along an axis of three.
    return np.asarray(cv2.transform(differences, SUM), np.float32) if differences.shape[-1] == 3 else differences[..., 0]


# Number of bins for each channel's 256 grey levels.
BINS = 16
# This share of the probability is spread evenly over all colours, so that no colour is impossible.
FLOOR = 0.04


def colour_bins(image: UInt8[np.ndarray, "*pixels channel"]) -> Int[np.ndarray, "*pixels"]:
    """The bin of each pixel's colour: one number for all its channels."""
    bins = np.zeros(image.shape[:-1], np.int32)
    for channel in np.moveaxis(image, -1, 0):
        bins *= BINS
        bins += channel // (256 // BINS)
    return bins


def colour_histogram(bins: Int[np.ndarray, "*pixels"], channels: int) -> Float[np.ndarray, " bin"]:
    """The probability of each colour, smoothed over neighbouring colours, nowhere zero."""
    shape = (BINS,) * channels
    counts = np.bincount(bins.ravel(), minlength=BINS**channels).astype(float).reshape(shape)
    for axis in range(channels):
        lower, upper = (np.roll(counts, step, axis) for step in (1, -1))
        # np.roll wraps around: remove what comes from the other end of the scale.
        np.moveaxis(lower, axis, 0)[0], np.moveaxis(upper, axis, 0)[-1] = 0, 0
        counts = (lower + 2 * counts + upper) / 4
    shares = counts / counts.sum() + FLOOR / counts.size
    return (shares / shares.sum()).ravel()
