r"""How much brighter or darker than a reference an image is, by trimmed least squares: for each colour channel

$$I(x, y) \approx g\,B(x, y) + \sum_{i+j \le 3} a_{ij}\, x^i y^j.$$

Automatic exposure and white balance act by the gain g and a constant; veiling glare and flickering lamps add what varies slowly over the image. A
person changes some pixels, abruptly: the line is fitted again and again to those pixels that it already explains.
"""

from functools import cache
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy.typing import NDArray

# About so many pixels, evenly spaced, settle eleven numbers a channel.
PIXELS = 4_000
ROUNDS = 4
DEGREE = 3
# Grey levels: what a pixel may be off however well the line fits.
LEAST_SPREAD = 2.0
# Beyond these a value may have been cut off, and says nothing about the line.
DARKEST, BRIGHTEST = 4, 250
STRONGEST_GAIN = 3.0
# An image of which fewer pixels lie within `AGREEING` grey levels of the line shows something else than the reference, or nothing.
LEAST_SHARE, AGREEING = 0.5, 20.0
# The slowly varying part is computed at so many points a side.
GRID = 16


class Exposure(NamedTuple):
    """image = gain * reference + offset; gain by channel, offset in grey levels by row, column and channel."""

    gain: Float[np.ndarray, " channel"]
    offset: Float[np.ndarray, "row column channel"]


def fit_exposure(image: UInt8[np.ndarray, "row column channel"], reference: Float[np.ndarray, "row column channel"]) -> Exposure | None:
    """What brings the reference to the image, or None where nothing does: another scene, a black or an overexposed image."""
    rows, columns, channels = image.shape
    stride = max(1, round(np.sqrt(rows * columns / PIXELS)))
    values, references = (a[::stride, ::stride].reshape(-1, channels).astype(np.float32) for a in (image, reference))
    terms = _terms(len(range(0, rows, stride)), len(range(0, columns, stride)))
    lines = np.array([_fit(references[:, c], values[:, c], terms) for c in range(channels)], np.float32)
    near = np.abs(values - np.clip(references * lines[:, 0] + terms @ lines[:, 1:].T, 0, 255)).max(axis=1) < AGREEING
    if near.mean() < LEAST_SHARE:
        return None
    field = (_terms(GRID, GRID) @ lines[:, 1:].T).reshape(GRID, GRID, channels)
    return Exposure(lines[:, 0], cv2.resize(field, (columns, rows), interpolation=cv2.INTER_LINEAR).reshape(rows, columns, channels))


@cache
def _terms(rows: int, columns: int) -> NDArray[np.float32]:
    """The monomials, (pixel, term), at evenly spaced points of an image whose sides go from -1 to 1."""
    x, y = np.meshgrid(*((np.arange(n) + 0.5) * 2 / n - 1 for n in (columns, rows)))
    return np.stack([(x**i * y**j).ravel() for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)], axis=1).astype(np.float32)


def _fit(x: NDArray[np.float32], y: NDArray[np.float32], terms: NDArray[np.float32]) -> NDArray[np.float32]:
    """Gain and the polynomial's coefficients; gain 1 and nothing added where too few values tell them."""
    unchanged = np.eye(1, 1 + terms.shape[1], dtype=np.float32)[0]
    whole = (x > DARKEST) & (x < BRIGHTEST) & (y > DARKEST) & (y < BRIGHTEST)
    x, y, terms = x[whole], y[whole], terms[whole]
    if x.size < 10 * terms.shape[1]:
        return unchanged
    columns = np.column_stack([x, terms])
    rest = y - np.median(y / x) * x
    line = unchanged
    for _ in range(ROUNDS):
        near = np.abs(rest) <= max(2.5 * 1.4826 * float(np.median(np.abs(rest))), LEAST_SPREAD)
        kept = columns[near]
        # A trace of a prior (gain 1, nothing added) settles what an image of one colour leaves open.
        normal = kept.T @ kept + np.eye(kept.shape[1], dtype=np.float32)
        line = unchanged + np.linalg.solve(normal, kept.T @ (y[near] - x[near])).astype(np.float32)
        rest = y - columns @ line
    return line if 1 / STRONGEST_GAIN < line[0] < STRONGEST_GAIN else unchanged
