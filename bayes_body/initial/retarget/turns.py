r"""Rotations as a joint's angles in order, $D = R_{a_1}(\pm s_1) R_{a_2}(\pm s_2) R_{a_3}(\pm s_3)$, and the remaining rotation.

Three angles, with different axes for neighbours, give every rotation in two ways. The second solution is $(s_1 + \pi, \pi - s_2, s_3 + \pi)$ if all
axes differ, and $(s_1 + \pi, -s_2, s_3 + \pi)$ if the first axis is also the third (Diebel 2006, Representing attitude, 5.6). Fewer angles give only
some rotations.
"""

import warnings
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

FULL = 2 * np.pi


class Angles(NamedTuple):
    """Angles of one joint over time, radians, and the remaining rotation that they do not reproduce in each frame, radians."""

    values: Float[np.ndarray, "frame turn"]
    left: Float[np.ndarray, " frame"]


def angles_of(
    rotations: Float[np.ndarray, "frame 3 3"],
    axes: Sequence[int],
    signs: Sequence[int],
    low: Float[np.ndarray, " turn"],
    high: Float[np.ndarray, " turn"],
) -> Angles | None:
    """Return the angles of every frame, without jumps, and within their limits if possible; None for axes that cannot be decomposed.

    Args:
        rotations: rotations of the joint relative to its rest.
        axes: 0, 1 or 2 for each angle, in order.
        signs: 1 or -1 for each angle.
        low: lower limits, radians, or infinite.
        high: upper limits, radians, or infinite.
    """
    count = len(axes)
    if not count:
        return Angles(np.zeros((len(rotations), 0)), Rotation.from_matrix(rotations).magnitude())
    if count > 3 or any(a == b for a, b in pairwise(axes)):
        return None
    both = _both(rotations, axes) * np.asarray(signs)
    chains = [_chained(both, _into(both[0, branch], low, high)) for branch in range(2)]
    residuals = [_residual(rotations, chain, axes, signs) for chain in chains]
    chosen = min(range(2), key=lambda k: (residuals[k].max() > residuals[1 - k].max() + 1e-9, *_cost(chains[k], low, high)))
    return Angles(chains[chosen], residuals[chosen])


def _both(rotations: Float[np.ndarray, "frame 3 3"], axes: Sequence[int]) -> Float[np.ndarray, "frame 2 turn"]:
    """Return the two solutions for the angles of every rotation, cut to the number of axes."""
    unused_axes = [axis for axis in range(3) if axis not in axes]
    order = [*axes, *unused_axes][:3]
    with warnings.catch_warnings():
        # In gimbal lock only the sum or difference of the outer angles is determined: scipy sets the last one to 0 and warns.
        warnings.simplefilter("ignore", UserWarning)
        first_solution = Rotation.from_matrix(rotations).as_euler("".join("XYZ"[axis] for axis in order))
    middle = -first_solution[:, 1] if order[0] == order[2] else np.pi - first_solution[:, 1]
    second_solution = np.stack([first_solution[:, 0] + np.pi, middle, first_solution[:, 2] + np.pi], axis=1)
    return np.stack([first_solution, second_solution], axis=1)[..., : len(axes)]


def _chained(both: Float[np.ndarray, "frame 2 turn"], start: Float[np.ndarray, " turn"]) -> Float[np.ndarray, "frame turn"]:
    """Return one solution for each frame, starting near `start`: the one nearer to the frame before, up to full turns."""
    chain = np.empty((len(both), both.shape[-1]))
    before = start
    for t, two in enumerate(both):
        near = two - FULL * np.round((two - before) / FULL)
        before = chain[t] = near[np.abs(near - before).sum(axis=1).argmin()]
    return chain


def _into(values: Float[np.ndarray, " turn"], low: Float[np.ndarray, " turn"], high: Float[np.ndarray, " turn"]) -> Float[np.ndarray, " turn"]:
    """Return the same angles, at most half a turn from the middle of their limits."""
    bounded = np.isfinite(low) & np.isfinite(high)
    middle = np.where(bounded, (np.where(bounded, low, 0.0) + np.where(bounded, high, 0.0)) / 2, 0.0)
    return values - FULL * np.round((values - middle) / FULL)


def _cost(chain: Float[np.ndarray, "frame turn"], low: Float[np.ndarray, " turn"], high: Float[np.ndarray, " turn"]) -> tuple[int, float]:
    """Return the number of angles outside their limits, then the sum of all angles' sizes."""
    return int(((chain < low - 1e-6) | (chain > high + 1e-6)).sum()), float(np.abs(chain).sum())


def _residual(
    rotations: Float[np.ndarray, "frame 3 3"], values: Float[np.ndarray, "frame turn"], axes: Sequence[int], signs: Sequence[int]
) -> np.ndarray:
    again = Rotation.from_euler("".join("XYZ"[axis] for axis in axes), values * np.asarray(signs))
    return (again.inv() * Rotation.from_matrix(rotations)).magnitude()
