"""Words that sentences about frames share."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

# Stretches of frames that a sentence names before it only counts.
MOST_STRETCHES = 6


def frame_ranges(frames: Sequence[int], most: int = MOST_STRETCHES) -> str:
    """`frame 3`, or `frames 3-7, 9`: ascending frames in words; beyond `most` stretches the rest is counted."""
    stretches: list[list[int]] = []
    for frame in frames:
        if stretches and stretches[-1][1] == frame - 1:
            stretches[-1][1] = frame
        else:
            stretches.append([frame, frame])
    named = ", ".join(str(first) if first == last else f"{first}-{last}" for first, last in stretches[:most])
    rest = sum(last - first + 1 for first, last in stretches[most:])
    return f"frame{'s' if len(frames) > 1 else ''} {named}{f' and {rest} more' if rest else ''}"


def frames_where(crossed: Bool[np.ndarray, " frame"]) -> str:
    """The frames that cross a limit, in words."""
    return frame_ranges(np.flatnonzero(crossed).tolist())


def largest(values: Float[np.ndarray, "frame k"]) -> Float[np.ndarray, " frame"]:
    """The largest of each row; -∞ where there is none."""
    return np.where(np.isnan(values), -np.inf, values).max(axis=1)


def at_worst(crossed: Bool[np.ndarray, " frame"], frame: int) -> str:
    """Where the worst is, if that is not said yet."""
    return f" at worst, at frame {frame}" if crossed.sum() > 1 else ""
