r"""The probability that a detection is a person's, given where all people are: the prior of the likelihood's sum (model/likelihood/candidates.py).

A detection k whose keypoints m lie $d_{pkm}$ pixels from the body of person p has the weight

$$w_{pk} = \frac{1 - \mu}{\mu} \prod_m \left[ (1 - \epsilon) \frac{t_\nu(d_{pkm}; s)}{b} + \epsilon \right]^{n / M}$$

for p, relative to p not being detected, which happens with probability $\mu$. t is Student's density in the image, with a scale s that is a fraction
of the person's size; b is the density of a point anywhere in the image. A network places the share $\epsilon$ of the keypoints anywhere. The M
keypoints of a detection err together, so they count as n. The body is the mean of those before and after the frame, so it hardly knows the frame's
detections. The distances do: the likelihood compares the same detection with the pose once more, so that shares of similar detections are more
decided than they should be. As constants of the frame they do not move the pose.

People exclude each other, as a detection is of one person at most. There are two ways:

- jointly: the sum over all assignments of detections to people, one to one. Person by person, with the set of the detections that are taken as the
  state, it is exact.
- mean field: each person has shares of his own, $q_{pk} \propto w_{pk} \prod_{r \ne p} (1 - q_{rk})$, which are iterated.
"""

import numpy as np
from jaxtyping import Float

# The scale of a keypoint's error as a fraction of the person's size, its degrees of freedom, and the share of keypoints that are anywhere.
SCALE, FREEDOM, STRAY = 0.025, 3.0, 0.05
# The keypoints of a detection count as so many.
INDEPENDENT = 5
# How often a network does not detect somebody who is in view.
MISSED = 0.05
# Weights stay below the largest number, even those of as many people as the exact sum allows.
MOST_LOG = 80.0
# So certain is a share at most: a network can always have detected somebody else.
MOST, LEAST = 0.999, 1e-3
ROUNDS = 30
# With more detections the states of the exact sum are too many.
MOST_EXACT = 8

type Weights = Float[np.ndarray, "*frame person detection"]
type Shares = Float[np.ndarray, "*frame person detection"]


def weights_of(offsets_px: Float[np.ndarray, "*frame person detection keypoint"], sizes_px: np.ndarray, area_px: float) -> Weights:
    """Return the weights of detections for people, relative to not being detected.

    Args:
        offsets_px: of the keypoints from the people's bodies; NaN where one is not known, at least one must be.
        sizes_px: (*frame, detection), of the detections.
        area_px: of the image, square pixels.
    """
    scale = SCALE * np.asarray(sizes_px)[..., None, :, None]
    tail = (1 + (offsets_px / scale) ** 2 / FREEDOM) ** (-(FREEDOM + 2) / 2)
    log_ratios = np.log((1 - STRAY) * area_px / (2 * np.pi * scale**2) * tail + STRAY)
    is_known = np.isfinite(log_ratios)
    mean = np.where(is_known, log_ratios, 0.0).sum(axis=-1) / is_known.sum(axis=-1)
    return np.exp(np.minimum(INDEPENDENT * mean + np.log((1 - MISSED) / MISSED), MOST_LOG))


def joint_shares(weights: Weights) -> Shares:
    """Return the shares by the sum over all one-to-one assignments.

    Args:
        weights: relative to not being detected; 0 for a detection that a person cannot have.
    """
    people, detections = weights.shape[-2:]
    if detections > MOST_EXACT:
        return mean_field_shares(weights)
    nobody = np.zeros((*weights.shape[:-2], 1 << detections))
    nobody[..., 0] = 1.0
    forward = [nobody]
    for person in range(people):
        forward.append(_with_person(forward[-1], weights[..., person, :]))
    # How much weight the people after this one can add, by the detections that are taken before them.
    backward = [np.ones(nobody.shape)]
    for person in reversed(range(people)):
        backward.append(_before_person(backward[-1], weights[..., person, :]))
    total, shares = forward[-1].sum(axis=-1), np.zeros(weights.shape)
    for person in range(people):
        for k in range(detections):
            free, taken = _sets(detections, k)
            ways = (forward[person][..., free] * backward[people - person - 1][..., taken]).sum(axis=-1)
            shares[..., person, k] = weights[..., person, k] * ways / total
    return _limited(shares)


def _with_person(weights_before: np.ndarray, weights: np.ndarray) -> np.ndarray:
    weights_after = weights_before.copy()
    for k in range(weights.shape[-1]):
        free, taken = _sets(weights.shape[-1], k)
        weights_after[..., taken] += weights[..., k, None] * weights_before[..., free]
    return weights_after


def _before_person(weights_after: np.ndarray, weights: np.ndarray) -> np.ndarray:
    weights_before = weights_after.copy()
    for k in range(weights.shape[-1]):
        free, taken = _sets(weights.shape[-1], k)
        weights_before[..., free] += weights[..., k, None] * weights_after[..., taken]
    return weights_before


def _sets(detections: int, k: int) -> tuple[np.ndarray, np.ndarray]:
    """The sets of detections without k, and these with it."""
    sets = np.arange(1 << detections)
    free = sets[(sets >> k & 1) == 0]
    return free, free | 1 << k


def mean_field_shares(weights: Weights) -> Shares:
    """Return the shares by iterated exclusion. Arguments as of `joint_shares`."""
    excluded, rivals = weights.copy(), 1 - np.eye(weights.shape[-1])
    for _ in range(ROUNDS):
        for person in range(weights.shape[-2]):
            total = 1 + excluded.sum(axis=-1, keepdims=True)
            # Without a difference of large numbers.
            free = (1 + excluded @ rivals) / total
            excluded[..., person, :] = weights[..., person, :] * np.delete(free, person, axis=-2).prod(axis=-2)
    return _limited(excluded / (1 + excluded.sum(axis=-1, keepdims=True)))


def _limited(shares: Shares) -> Shares:
    shares = np.where(shares < LEAST, 0.0, shares)
    return shares * np.minimum(1.0, MOST / np.maximum(shares.sum(axis=-1, keepdims=True), MOST))
