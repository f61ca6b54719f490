r"""Rotations as a joint's angles in their order, $D = R_{a_1}(\pm s_1) R_{a_2}(\pm s_2) R_{a_3}(\pm s_3)$, and how much of the rotation they leave.

Three angles about unlike neighbouring axes give every rotation, twice: $(s_1 + \pi, \pi - s_2, s_3 + \pi)$ is the same where all axes differ, and
$(s_1 + \pi, -s_2, s_3 + \pi)$ where the first is the third (Diebel 2006, Representing attitude, 5.6). Fewer angles give some rotations only.
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
    """Angles of one joint over time, radians, and what each frame's leave of its rotation, radians."""

    values: Float[np.ndarray, "frame turn"]
    left: Float[np.ndarray, " frame"]


def angles_of(
    rotations: Float[np.ndarray, "frame 3 3"],
    axes: Sequence[int],
    signs: Sequence[int],
    low: Float[np.ndarray, " turn"],
    high: Float[np.ndarray, " turn"],
) -> Angles | None:
    """The angles of every frame, without jumps, within their limits where both can be had; None for axes that this cannot take apart.

    Args:
        rotations: of the joint against its rest.
        axes: 0, 1 or 2 for each angle, in order.
        signs: 1 or -1 for each angle.
        low: limits, radians, or infinite.
        high: likewise.
    """
    count = len(axes)
    if not count:
        return Angles(np.zeros((len(rotations), 0)), Rotation.from_matrix(rotations).magnitude())
    if count > 3 or any(a == b for a, b in pairwise(axes)):
        return None
    both = _both(rotations, axes) * np.asarray(signs)
    chains = [_chained(both, _into(both[0, branch], low, high)) for branch in range(2)]
    left = [_left(rotations, chain, axes, signs) for chain in chains]
    chosen = min(range(2), key=lambda k: (left[k].max() > left[1 - k].max() + 1e-9, *_cost(chains[k], low, high)))
    return Angles(chains[chosen], left[chosen])


def _both(rotations: Float[np.ndarray, "frame 3 3"], axes: Sequence[int]) -> Float[np.ndarray, "frame 2 turn"]:
    """The two triples of angles of every rotation, as far as there are axes."""
    rest = [axis for axis in range(3) if axis not in axes]
    order = [*axes, *rest][:3]
    with warnings.catch_warnings():
        # Where the middle angle is a right one only the sum of the others is determined: scipy sets the last to 0 and says so.
        warnings.simplefilter("ignore", UserWarning)
        one = Rotation.from_matrix(rotations).as_euler("".join("XYZ"[axis] for axis in order))
    middle = -one[:, 1] if order[0] == order[2] else np.pi - one[:, 1]
    other = np.stack([one[:, 0] + np.pi, middle, one[:, 2] + np.pi], axis=1)
    return np.stack([one, other], axis=1)[..., : len(axes)]


def _chained(both: Float[np.ndarray, "frame 2 turn"], start: Float[np.ndarray, " turn"]) -> Float[np.ndarray, "frame turn"]:
    """From `start` on, in every frame that of the two which is nearer to the frame before, up to full turns."""
    chain = np.empty((len(both), both.shape[-1]))
    before = start
    for t, two in enumerate(both):
        near = two - FULL * np.round((two - before) / FULL)
        before = chain[t] = near[np.abs(near - before).sum(axis=1).argmin()]
    return chain


def _into(values: Float[np.ndarray, " turn"], low: Float[np.ndarray, " turn"], high: Float[np.ndarray, " turn"]) -> Float[np.ndarray, " turn"]:
    """The same angles, less than half a turn from the middle of their limits."""
    bounded = np.isfinite(low) & np.isfinite(high)
    middle = np.where(bounded, (np.where(bounded, low, 0.0) + np.where(bounded, high, 0.0)) / 2, 0.0)
    return values - FULL * np.round((values - middle) / FULL)


def _cost(chain: Float[np.ndarray, "frame turn"], low: Float[np.ndarray, " turn"], high: Float[np.ndarray, " turn"]) -> tuple[int, float]:
    """Angles outside their limits, then how large they are."""
    return int(((chain < low - 1e-6) | (chain > high + 1e-6)).sum()), float(np.abs(chain).sum())


def _left(
    rotations: Float[np.ndarray, "frame 3 3"], values: Float[np.ndarray, "frame turn"], axes: Sequence[int], signs: Sequence[int]
) -> np.ndarray:
    again = Rotation.from_euler("".join("XYZ"[axis] for axis in axes), values * np.asarray(signs))
    return (again.inv() * Rotation.from_matrix(rotations)).magnitude()
