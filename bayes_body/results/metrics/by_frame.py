"""Figures of many frames as arrays: a few numbers a frame, without an object for each of them."""

from collections.abc import Iterable
from typing import Any

import jax
import numpy as np

# So many frames are stacked at once: an array of few numbers takes several times the memory of its numbers.
BLOCK = 256


def stack_frames[Figures: tuple[Any, ...]](frames: Iterable[Figures]) -> Figures:
    """Return the figures of the frames as one named tuple, each field with a leading axis (frame,). Each frame is let go as soon as it is read.

    Args:
        frames: named tuples of arrays, numbers and named tuples of these; all of the same form. There is at least one.
    """
    structure, blocks, waiting = None, list[list[np.ndarray]](), list[list[Any]]()
    for figures in frames:
        leaves, structure = jax.tree.flatten(figures)
        waiting.append(leaves)
        if len(waiting) == BLOCK:
            blocks.append(_stacked(waiting))
            waiting = []
    if waiting:
        blocks.append(_stacked(waiting))
    assert structure is not None
    return jax.tree.unflatten(structure, [np.concatenate(parts) for parts in zip(*blocks, strict=True)])


def _stacked(frames: list[list[Any]]) -> list[np.ndarray]:
    return [np.stack(values) for values in zip(*frames, strict=True)]
