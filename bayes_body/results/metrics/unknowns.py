"""What a run says in its last frame about the unknowns of its model: each entry against its prior, for `summary.json`.

The last frame of a filter knows all images. An unknown has the same prior in every frame, so that posterior and prior can be compared. The ratio of
their standard deviations says how much the images told: 1 is nothing.

Where lengths are wrong and not among the unknowns, joints bend to make up for them, until their limits stop them: `near_limits` finds these.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool

from bayes_body.density.spaces import Flat
from bayes_body.model.body.solids import configuration_space
from bayes_body.model.build import Model
from bayes_body.model.unknowns.unknown import Unknown
from bayes_body.results.posterior.agreement import independent_draws
from bayes_body.results.posterior.blocks import Block, weights_of_runs
from bayes_body.results.posterior.thinning import MEAN, RHAT, weighted_mean
from bayes_body.results.posterior.weighted import frame_rhat
from bayes_body.tracking.draws import FrameResult

# A dof is near its limit if its mean is less than this many standard deviations away, and if its range is more than so many. What is not known at all
# is near every limit.
NEAR_LIMIT, LEAST_RANGE = 2.0, 8.0


def unknown_figures(model: Model, frame: FrameResult, index: int, is_sample: bool = True) -> dict[str, Any]:
    """Return the table `unknowns` of the summary, and the unknowns' largest R-hat and fewest independent draws; nothing for a model without any.

    Args:
        model: the model of the run.
        frame: the last frame.
        index: its number.
        is_sample: whether the particles are a sample of the posterior; if not, their spread is no figure of an entry.
    """
    if not model.unknowns:
        return {}
    rows = [row for term in model.unknowns for row in _rows(term, frame, index, is_sample)]
    rhats = [row["rhat"] for row in rows if row["rhat"] is not None]
    draws = [independent_draws(_block(term, frame))[0] for term in model.unknowns]
    finite_draws = [float(count) for count in draws if np.isfinite(count)]
    return {"unknowns": rows, "unknowns_rhat_max": max(rhats, default=None), "unknowns_independent_draws_min": min(finite_draws, default=None)}


def _rows(term: Unknown, frame: FrameResult, index: int, is_sample: bool) -> Iterator[dict[str, Any]]:
    """Yield the figures of each entry, over all runs, in the unit of the entry."""
    frame = _with_named(term, frame)
    values, weights = np.asarray(frame.states[term.name], float), weights_of_runs(np.asarray(frame.log_weights, float)[..., None])
    means = np.asarray(weighted_mean(frame, term.name, term.space), float)
    variance = (weights * (values - means[:, None]) ** 2).sum(axis=1).mean(axis=0) + means.var(axis=0)
    mean, sd = means.mean(axis=0), np.sqrt(variance)
    prior_mean, prior_sd = term.named(np.asarray(term.mean, float)), term.named_sd()
    rhat = frame_rhat(frame, index, term.name, term.space)
    for place, (label, unit) in enumerate(zip(term.space.labels, term.space.units, strict=True)):
        yield {
            "name": term.name,
            "entry": label,
            "unit": unit,
            "prior_mean": float(prior_mean[place]),
            "prior_sd": float(prior_sd[place]),
            "mean": float(mean[place]),
            "sd": float(sd[place]) if is_sample else None,
            "sd_ratio": float(sd[place] / prior_sd[place]) if is_sample else None,
            "rhat": float(rhat[place]) if np.isfinite(rhat[place]) else None,
        }


def _with_named(term: Unknown, frame: FrameResult) -> FrameResult:
    """Return the frame with what the labels name in place of the unknown's entries."""
    if term.mixing is None:
        return frame
    # The mean of all particles mixes as they do. R-hat does not: it is that of the particles that are stored.
    figures = {name: values for name, values in frame.figures.items() if name != RHAT + term.name}
    figures |= {name: term.named(values) for name, values in figures.items() if name == MEAN + term.name}
    return replace(frame, states={**frame.states, term.name: term.named(np.asarray(frame.states[term.name], float))}, figures=figures)


def _block(term: Unknown, frame: FrameResult) -> Block:
    log_weights = np.asarray(frame.log_weights, float)[..., None]
    return Block(range(1), np.asarray(frame.states[term.name], float)[:, :, None], log_weights)


def near_limits(model: Model, frame: FrameResult) -> Bool[np.ndarray, " dof"]:
    """Return whether each dof is near a limit in all runs; no dofs for a body that is placed by its parts."""
    space = configuration_space(model.body)
    if not isinstance(space, Flat):
        return np.zeros(0, bool)
    low, high = np.asarray(space.low), np.asarray(space.high)
    means = np.asarray(weighted_mean(frame, model.body.variable, space), float)
    weights = weights_of_runs(np.asarray(frame.log_weights, float)[..., None])
    sd = np.sqrt((weights * (np.asarray(frame.states[model.body.variable], float) - means[:, None]) ** 2).sum(axis=1))
    distance = np.minimum(means - low, high - means)
    # A dof without limits has an infinite distance from them.
    return ((distance < NEAR_LIMIT * sd) & (high - low > LEAST_RANGE * sd)).all(axis=0)


def near_limit_shares(model: Model, by_frame: Bool[np.ndarray, "frame dof"] | None) -> dict[str, float]:
    """Return the share of the frames in which a dof is near its limit, by name; dofs that never are have none.

    Args:
        model: the model of the run.
        by_frame: from `near_limits`; None where the particles are no sample.
    """
    if by_frame is None or not by_frame.size:
        return {}
    shares = np.mean(by_frame, axis=0)
    return {name: float(share) for name, share in zip(model.body.dof_names, shares, strict=True) if share > 0}
