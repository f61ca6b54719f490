r"""The probability that a detection is a person's, given where all people are: the prior of the likelihood's sum (model/likelihood/candidates.py).

A detection k that lies at the distance $e_{pk}$ from the body of person p, as a fraction of the person's size, has the weight
$w_{pk} = \exp(-e_{pk}^2 / 2 s^2)$ for p; that p is not detected has the weight $w_0$. The body is the mean of those before and after the frame: the
detections of the frame itself, which the likelihood reads, do not count twice.

People exclude each other, as a detection is of one person at most. There are two ways:

- jointly: the sum over all assignments of detections to people, one to one. Person by person, with the set of the detections that are taken as the
  state, it is exact.
- mean field: each person has shares of his own, $q_{pk} \propto w_{pk} \prod_{r \ne p} (1 - q_{rk})$, which are iterated.
"""

import numpy as np
from jaxtyping import Float

# The standard deviation of the distance, and the weight of not being detected: that of a distance of three standard deviations.
SPREAD, MISSED = 0.05, float(np.exp(-0.5 * 3.0**2))
# So certain is a share at most: a network can always have detected somebody else.
MOST, LEAST = 0.999, 1e-3
ROUNDS = 30
# With more detections the states of the exact sum are too many.
MOST_EXACT = 8

type Weights = Float[np.ndarray, "person detection"]
type Shares = Float[np.ndarray, "person detection"]


def weights_of(distances: Float[np.ndarray, "person detection"]) -> Weights:
    """Return the weights of distances; 0 for infinite ones."""
    return np.exp(-0.5 * (distances / SPREAD) ** 2)


def joint_shares(weights: Weights) -> Shares:
    """Return the shares by the sum over all one-to-one assignments."""
    people, detections = weights.shape
    if detections > MOST_EXACT:
        return mean_field_shares(weights)
    states = 1 << detections
    forward = [np.eye(1, states)[0]]
    for person in range(people):
        forward.append(_with_person(forward[-1], weights[person]))
    # How much weight the people after this one can add, by the detections that are taken before them.
    backward = [np.ones(states)]
    for person in reversed(range(people)):
        backward.append(_before_person(backward[-1], weights[person]))
    total = forward[-1].sum()
    shares, sets = np.zeros(weights.shape), np.arange(states)
    for person in range(people):
        remainder = backward[people - person - 1]
        for k in range(detections):
            free = sets[(sets >> k & 1) == 0]
            shares[person, k] = weights[person, k] * (forward[person][free] * remainder[free | 1 << k]).sum() / total
    return _limited(shares)


def _with_person(weights_before: np.ndarray, weights: np.ndarray) -> np.ndarray:
    weights_after, sets = MISSED * weights_before, np.arange(len(weights_before))
    for k, weight in enumerate(weights):
        free = sets[(sets >> k & 1) == 0]
        weights_after[free | 1 << k] += weight * weights_before[free]
    return weights_after


def _before_person(weights_after: np.ndarray, weights: np.ndarray) -> np.ndarray:
    weights_before, sets = MISSED * weights_after, np.arange(len(weights_after))
    for k, weight in enumerate(weights):
        free = sets[(sets >> k & 1) == 0]
        weights_before[free] += weight * weights_after[free | 1 << k]
    return weights_before


def mean_field_shares(weights: Weights) -> Shares:
    """Return the shares by iterated exclusion."""
    shares = weights / (MISSED + weights.sum(axis=1, keepdims=True))
    for _ in range(ROUNDS):
        for person in range(len(weights)):
            remainder = np.prod(1 - np.delete(shares, person, axis=0), axis=0)
            excluded = weights[person] * remainder
            shares[person] = excluded / (MISSED + excluded.sum())
    return _limited(shares)


def _limited(shares: Shares) -> Shares:
    shares = np.where(shares < LEAST, 0.0, shares)
    return shares * np.minimum(1.0, MOST / np.maximum(shares.sum(axis=1, keepdims=True), MOST))
