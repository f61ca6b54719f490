"""Smooth histograms of colours: densities of the colours of a scene or of a person."""

import numpy as np
from jaxtyping import Float, Int, UInt8

# Number of bins for each channel's 256 grey levels.
BINS = 16
# This share of the probability is spread evenly over all colours, so that no colour is impossible.
FLOOR = 0.04


def colour_bins(image: UInt8[np.ndarray, "*pixels channel"]) -> Int[np.ndarray, "*pixels"]:
    """The bin of each pixel's colour: one number for all its channels."""
    bins = np.zeros(image.shape[:-1], np.int32)
    for channel in np.moveaxis(image, -1, 0):
        bins = bins * BINS + channel.astype(np.int32) * BINS // 256
    return bins


def colour_histogram(bins: Int[np.ndarray, "*pixels"], channels: int) -> Float[np.ndarray, " bin"]:
    """The probability of each colour, smoothed over neighbouring colours, nowhere zero."""
    shape = (BINS,) * channels
    counts = np.bincount(bins.ravel(), minlength=BINS**channels).astype(float).reshape(shape)
    for axis in range(channels):
        before, after = (np.roll(counts, step, axis) for step in (1, -1))
        # np.roll wraps around: remove what comes from the other end of the scale.
        np.moveaxis(before, axis, 0)[0], np.moveaxis(after, axis, 0)[-1] = 0, 0
        counts = (before + 2 * counts + after) / 4
    shares = counts / counts.sum() + FLOOR / counts.size
    return (shares / shares.sum()).ravel()
