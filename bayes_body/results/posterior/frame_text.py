"""Wording shared by sentences about frames."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

# Number of stretches of frames that a sentence names; it only counts the rest.
MOST_STRETCHES = 6


def frame_ranges(frames: Sequence[int], most: int = MOST_STRETCHES) -> str:
    """Return ascending frames in words, such as `frame 3` or `frames 3-7, 9`; beyond `most` stretches the rest is only counted."""
    stretches: list[list[int]] = []
    for frame in frames:
        if stretches and stretches[-1][1] == frame - 1:
            stretches[-1][1] = frame
        else:
            stretches.append([frame, frame])
    named = ", ".join(str(first) if first == last else f"{first}-{last}" for first, last in stretches[:most])
    remainder = sum(last - first + 1 for first, last in stretches[most:])
    return f"frame{'s' if len(frames) > 1 else ''} {named}{f' and {remainder} more' if remainder else ''}"


def frames_where(crossed: Bool[np.ndarray, " frame"], first: int) -> str:
    """Return the frames that cross a limit, in words; `first` is the number of the first frame."""
    return frame_ranges((first + np.flatnonzero(crossed)).tolist())


def largest(values: Float[np.ndarray, "frame k"]) -> Float[np.ndarray, " frame"]:
    """Return the largest value of each row; -∞ if it has none."""
    return np.where(np.isnan(values), -np.inf, values).max(axis=1)


def at_worst(crossed: Bool[np.ndarray, " frame"], number: int) -> str:
    """Return words that name the worst frame; empty if only one frame crosses the limit."""
    return f" at worst, at frame {number}" if crossed.sum() > 1 else ""
