"""Several activities in one hidden Markov model: how many states each has, and how one changes to another."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import input_error
from bayes_body.workshop.learning.baum_welch import Hmm

# Fewest frames of each state, and fewest states of each activity.
FRAMES, STATES = 10, 4


def shares_of(frames: Mapping[str, int], states: int) -> dict[str, int]:
    """Return the number of states of each activity, in proportion to its frames, and at least `STATES`. One activity has all states.

    Raises:
        InputError: too few states for the activities, or too few frames for the states.
    """
    shares = _in_proportion(frames, states) if len(frames) > 1 else dict.fromkeys(frames, states)
    for label, count in shares.items():
        if frames[label] < FRAMES * count:
            problem = f"{frames[label]} frames for {count} states"
            raise input_error(f"activity '{label}'", problem, f"at least {FRAMES} frames a state", "learn fewer states, or give more motion")
    return shares


def _in_proportion(frames: Mapping[str, int], states: int) -> dict[str, int]:
    if states < STATES * len(frames):
        problem = f"{states} for {len(frames)} activities"
        raise input_error("states", problem, f"at least {STATES} for each activity", "learn more states, or fewer activities")
    shares = dict.fromkeys(frames, STATES)
    for _ in range(states - sum(shares.values())):
        # The next state goes to the activity that has most frames for each state.
        shares[max(shares, key=lambda label: frames[label] / shares[label])] += 1
    return shares


def joined(models: Sequence[Hmm], switch: float) -> Hmm:
    """Return one model of several, with the probability `switch` per frame of leaving one for the states of the others.

    Those states are as likely then as after a long time in their own model. The initial probabilities are shared in proportion to the states.
    """
    sizes = [len(model.initial) for model in models]
    ends = np.cumsum(sizes)
    blocks = [slice(end - size, end) for end, size in zip(ends, sizes, strict=True)]
    switch = switch if len(models) > 1 else 0.0
    transition = np.zeros((ends[-1], ends[-1]))
    for row, model in zip(blocks, models, strict=True):
        for column, target in zip(blocks, models, strict=True):
            switches = switch / max(len(models) - 1, 1) * stationary(np.asarray(target.transition))
            transition[row, column] = (1 - switch) * np.asarray(model.transition) if row == column else switches
    initial = np.concatenate([size / ends[-1] * np.asarray(model.initial) for size, model in zip(sizes, models, strict=True)])
    return Hmm(initial, transition, *(np.concatenate([np.asarray(model[k]) for model in models]) for k in (2, 3)))


def stationary(transition: Float[np.ndarray, "state state"]) -> Float[np.ndarray, " state"]:
    """Return the probabilities of the states after a long time, from equal ones at first."""
    # A chain that stays with probability 1/2 has the same ones, and never alternates.
    lazy = (np.eye(len(transition)) + transition) / 2
    later = np.linalg.matrix_power(lazy, 2**14).mean(axis=0)
    return later / later.sum()
