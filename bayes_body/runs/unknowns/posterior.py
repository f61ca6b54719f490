"""What the last frame's draws say of the unknowns: its filter has seen all frames."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.model.build import Model
from bayes_body.model.unknowns.lengths import lengths_of, log_sd_of
from bayes_body.results.metrics.unknown_sentences import UNDETERMINED
from bayes_body.tracking.draws import FrameResult


class Posterior(NamedTuple):
    """What is known of one unknown after the frames, in the unit of each entry.

    Attributes:
        labels: name of each entry.
        units: unit of each.
        prior_mean: what the session says.
        prior_sd: how uncertain that was.
        mean: the posterior mean, of all runs.
        sd: the posterior standard deviation, of all runs.
        remaining: share of the prior's standard deviation that is left.
        disagreement: largest difference between the means of two runs, in posterior standard deviations.
        common: of lengths, the relative standard deviation that all have in common; 0 for other unknowns.
    """

    labels: tuple[str, ...]
    units: tuple[str, ...]
    prior_mean: Float[np.ndarray, " entry"]
    prior_sd: Float[np.ndarray, " entry"]
    mean: Float[np.ndarray, " entry"]
    sd: Float[np.ndarray, " entry"]
    remaining: Float[np.ndarray, " entry"]
    disagreement: Float[np.ndarray, " entry"]
    common: float = 0.0


LENGTHS, LEAST_COMMON = "lengths", 1e-3


def posteriors_of(model: Model, frame: FrameResult) -> dict[str, Posterior]:
    """Return what a frame's draws say of each unknown, by name. Lengths are in metres.

    Args:
        model: the model, with unknowns.
        frame: of two runs or more.
    """
    weights = np.exp(np.asarray(frame.log_weights, float))
    posteriors = {}
    for term in model.unknowns:
        draws, sd = np.asarray(frame.states[term.name], float), np.asarray(term.sd, float)
        mean, labels, units = np.asarray(term.mean, float), term.space.labels, term.space.units
        posterior, common = _moments(draws, weights), 0.0
        if term.name == LENGTHS:
            lengths, logarithms = lengths_of(term, mean), log_sd_of(term)
            used = np.abs(lengths) > 0
            labels = tuple(name for name, is_used in zip(model.definition.body.lengths_of_height, used, strict=True) if is_used)
            in_metres = lengths_of(term, draws)[..., used]
            remaining = _moments(np.log(in_metres / lengths[used]), weights)[1] / logarithms[used]
            mean, sd, units = lengths[used], lengths[used] * logarithms[used], ("m",) * len(labels)
            posterior, common = _moments(in_metres, weights), _common_sd(draws[..., :1] + draws[..., 1:], weights)
        else:
            remaining = posterior[1] / sd
        posteriors[term.name] = Posterior(labels, units, mean, sd, posterior[0], posterior[1], remaining, posterior[2], common)
    return posteriors


def _common_sd(logarithms: Float[np.ndarray, "run draw bone"], weights: Float[np.ndarray, "run draw"]) -> float:
    """Return the standard deviation that the logarithms of all bones have in common: the root of their mean covariance."""
    deviations = logarithms - np.einsum("rd,rdb->rb", weights, logarithms)[:, None]
    covariance = np.einsum("rd,rdb,rdc->rbc", weights, deviations, deviations).mean(axis=0)
    pairs = len(covariance) * (len(covariance) - 1)
    shared = (covariance.sum() - np.trace(covariance)) / pairs if pairs else 0.0
    # Lengths that go against each other have nothing in common. A standard deviation is positive.
    return float(np.sqrt(max(shared, LEAST_COMMON**2)))


def _moments(
    draws: Float[np.ndarray, "run draw entry"], weights: Float[np.ndarray, "run draw"]
) -> tuple[Float[np.ndarray, " entry"], Float[np.ndarray, " entry"], Float[np.ndarray, " entry"]]:
    """Return mean and standard deviation of the draws of all runs, and the largest difference between runs in standard deviations."""
    means = np.einsum("rd,rde->re", weights, draws)
    within = np.einsum("rd,rde->re", weights, (draws - means[:, None]) ** 2).mean(axis=0)
    # The mean of all draws is as far from each run's as the runs are from each other: this belongs to the uncertainty of the result.
    sd = np.sqrt(within + means.var(axis=0))
    return means.mean(axis=0), sd, np.ptp(means, axis=0) / np.sqrt(within)


def as_json(posteriors: Mapping[str, Posterior]) -> dict[str, list[dict[str, object]]]:
    """Return the numbers for a file: of each unknown, one table an entry."""
    return {
        name: [
            {
                "name": label,
                "unit": values.units[index],
                "prior_mean": float(values.prior_mean[index]),
                "prior_sd": float(values.prior_sd[index]),
                "mean": float(values.mean[index]),
                "sd": float(values.sd[index]),
                "determined": bool(values.remaining[index] <= UNDETERMINED),
                "runs_apart_sd": float(values.disagreement[index]),
            }
            for index, label in enumerate(values.labels)
        ]
        for name, values in posteriors.items()
    }
