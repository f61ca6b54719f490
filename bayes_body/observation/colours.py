"""Densities of colours as smooth histograms: what colours a scene has, or a person."""

import numpy as np
from jaxtyping import Float, Int, UInt8

# Of each channel's 256 grey levels.
BINS = 16
# The share of all colours together that is spread evenly: no colour is impossible.
FLOOR = 0.04


def colour_bins(image: UInt8[np.ndarray, "*pixels channel"]) -> Int[np.ndarray, "*pixels"]:
    """The bin of each pixel's colour: a number for all its channels."""
    found = np.zeros(image.shape[:-1], np.int32)
    for channel in np.moveaxis(image, -1, 0):
        found = found * BINS + channel.astype(np.int32) * BINS // 256
    return found


def colour_histogram(bins: Int[np.ndarray, "*pixels"], channels: int) -> Float[np.ndarray, " bin"]:
    """The share of each colour, smoothed over neighbouring colours, nowhere zero."""
    shape = (BINS,) * channels
    counts = np.bincount(bins.ravel(), minlength=BINS**channels).astype(float).reshape(shape)
    for axis in range(channels):
        before, after = (np.roll(counts, step, axis) for step in (1, -1))
        # What rolls round comes from the far end of the scale.
        np.moveaxis(before, axis, 0)[0], np.moveaxis(after, axis, 0)[-1] = 0, 0
        counts = (before + 2 * counts + after) / 4
    shares = counts / counts.sum() + FLOOR / counts.size
    return (shares / shares.sum()).ravel()
