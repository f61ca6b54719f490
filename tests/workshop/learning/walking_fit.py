"""How well a walking cycle in joint angles explains a walk: coefficients that all frames share, and a phase for each frame."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import input_error
from bayes_body.model.body.skeleton import Topology
from bayes_body.model.dynamics.angle_cycle import AngleCycle
from bayes_body.workshop.learning.gait import terms
from bayes_body.workshop.learning.walking_angles import AngleWalk, near_reference, strikes_of

# Candidates for a change of phase, cycles, and how often phase and coefficients are fitted in turn.
NEARBY, ROUNDS = np.linspace(-0.04, 0.04, 17), 6


def aligned(walk: AngleWalk, cycle: AngleCycle, topology: Topology) -> AngleWalk:
    """Return the walk with the solutions and turns of its angles that are nearest to the cycle's."""
    return walk._replace(angles=near_reference(topology, walk.angles, cycle.mean[0]))


class Reconstruction(NamedTuple):
    """A walk by a cycle: the root mean square over all joint angles and frames, degrees; coefficients; the phase of each frame, cycles."""

    error_deg: float
    coefficients: Float[np.ndarray, " mode"]
    phase: Float[np.ndarray, " frame"]


def reconstruct(cycle: AngleCycle, walk: AngleWalk, components: int) -> Reconstruction:
    """Fit a walk by the first modes of a cycle: least squares of coefficients that all frames share, and of the phase of each frame.

    Args:
        cycle: the walking cycle.
        walk: the walk, `aligned` with the cycle.
        components: number of modes.
    """
    modes, phase = cycle.modes[:components], _phase(walk)
    coefficients, own = np.zeros(len(modes)), cycle.mean
    for _ in range(ROUNDS):
        T = terms(phase)
        coefficients = np.linalg.lstsq(np.stack([(T @ mode).ravel() for mode in modes], axis=1), (walk.angles - T @ cycle.mean).ravel(), rcond=None)[
            0
        ]
        own = cycle.mean + np.tensordot(coefficients, modes, 1)
        candidates = phase[:, None] + NEARBY
        poses = (terms(candidates.ravel()) @ own).reshape(*candidates.shape, -1)
        nearest = ((poses - walk.angles[:, None]) ** 2).sum(axis=-1).argmin(axis=1)
        phase = candidates[np.arange(len(phase)), nearest]
    error = np.sqrt(np.mean((walk.angles - terms(phase) @ own) ** 2))
    return Reconstruction(float(np.degrees(error)), coefficients, phase)


def _phase(walk: AngleWalk) -> Float[np.ndarray, " frame"]:
    """Return a first guess of the phase: half a cycle from each heel strike to the other heel's, and at the same rate before and after."""
    frames = [(int(frame), shift) for side, shift in (("l", 0.0), ("r", 0.5)) for frame in strikes_of(walk.points, walk.fps, side)]
    if len(frames) < 2:
        raise input_error(walk.name, f"{len(frames)} heel strikes", "at least 2", "give a walk of two steps or more")
    strikes = np.array(sorted(frames))
    phase = strikes[0, 1] + 0.5 * np.arange(len(strikes))
    rate = (phase[-1] - phase[0]) / (strikes[-1, 0] - strikes[0, 0])
    at = np.arange(len(walk.angles))
    inside = np.interp(at, strikes[:, 0], phase)
    return inside + rate * (np.minimum(at - strikes[0, 0], 0) + np.maximum(at - strikes[-1, 0], 0))
