r"""Fewer draws of a frame, which are still a weighted sample of its posterior, and figures of all particles beside them.

The draws are chosen as Fearnhead & Clifford (2003, On-line inference for hidden Markov models via particle filters, 3.2) choose particles: with the
threshold c that solves $\sum_i \min(w_i / c, 1) = n$, a particle of a weight above c stays with its weight, and each of the others stays with
probability $w_i / c$ and then has the weight c. So the expected weight of a particle is its weight, and no draw occurs twice; no other choice with
these properties has a smaller variance of the weights. The others are chosen systematically, in the order in which they are stored.

Draws of Markov chains, which are stored one chain after the other, are thinned evenly within each chain.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from bayes_body.density.factor import Transition
from bayes_body.density.kernel import NO_ANCESTOR
from bayes_body.density.spaces import Space
from bayes_body.results.posterior.agreement import chain_rhat, independent_draws, rhat_of_block
from bayes_body.results.posterior.blocks import Block, around_mean, weights_of_runs
from bayes_body.results.posterior.pareto import pareto_shape
from bayes_body.tracking.draws import FrameResult

# Before the names of the figures in the tree's group `filter`.
OF_ALL = "all_"
# Figures of all particles that are not one number of each run; a variable's name follows the last three.
INDEPENDENT, MEAN, RHAT, MARKOV_RHAT = "independent_draws", "mean_", "rhat_", "markov_rhat_"
SEED = 20030


def thinned(frame: FrameResult, number: int, draws: int, spaces: Mapping[str, Space]) -> FrameResult:
    """Return a frame with at most `draws` of its particles in each run, and figures of all; the frame itself if it has no more.

    Ancestors are unknown in the result, since most of them are gone.

    Args:
        frame: a frame with all particles.
        number: its number, which gives each frame its own random numbers.
        draws: number of draws; of Markov chains a multiple of the number of chains, or the next smaller one.
        spaces: where the variables of its states live.
    """
    runs, particles = frame.log_weights.shape
    if particles <= draws:
        return frame
    weights = weights_of_runs(frame.log_weights[..., None].astype(float))[..., 0]
    info = frame.info._replace(ancestors=np.full_like(frame.info.ancestors[:, :1], NO_ANCESTOR))
    if "length" in info.markov:
        length = min(int(np.max(info.markov["length"])), particles)
        chains = particles // length
        of_run = _evenly_in_chains(chains, length, max(draws // chains, 1))
        places = np.broadcast_to(of_run, (runs, len(of_run)))
        kept_length = np.full_like(info.markov["length"], places.shape[1] // chains)
        info, thinned_weights = info._replace(markov={**info.markov, "length": kept_length}), np.take_along_axis(weights, places, axis=1)
    else:
        rng = np.random.default_rng((SEED, number))
        places, thinned_weights = (np.stack(parts) for parts in zip(*(choose(rng, of_run, draws) for of_run in weights), strict=True))
    with np.errstate(divide="ignore"):
        log_weights = np.log(thinned_weights / thinned_weights.sum(axis=1, keepdims=True)).astype(frame.log_weights.dtype)
    return FrameResult(
        {name: np.stack([values[run, places[run]] for run in range(runs)]) for name, values in frame.states.items()},
        log_weights,
        info._replace(ancestors=np.repeat(info.ancestors, places.shape[1], axis=1)),
        frame.seen,
        frame.seconds,
        frame.seconds_ready,
        frame.restarted,
        figures_of_all(frame, number, spaces),
    )


def thinning_of(transition: Transition, draws: int | None) -> Callable[[FrameResult, int], FrameResult] | None:
    """Return what a run stores of a frame, given its number (`thinned`); None if it stores all particles.

    Args:
        transition: the model's, which knows where the variables live.
        draws: number of draws; None for all particles.
    """
    if draws is None:
        return None

    def store(frame: FrameResult, number: int) -> FrameResult:
        return thinned(frame, number, draws, {name: transition.space(name, values.shape[2:]) for name, values in frame.states.items()})

    return store


def choose(
    rng: np.random.Generator, weights: Float[np.ndarray, " particle"], draws: int
) -> tuple[Int[np.ndarray, " draw"], Float[np.ndarray, " draw"]]:
    """Return which particles stay, in their order, and their weights.

    Args:
        rng: source of random numbers.
        weights: weights that sum to one.
        draws: number of draws, smaller than that of particles.
    """
    if np.count_nonzero(weights) <= draws:
        # All that count stay. Some without weight fill the place.
        places = np.sort(np.argsort(-weights, kind="stable")[:draws])
        return places, weights[places]
    threshold = _threshold(weights, draws)
    stays = weights >= threshold
    places = np.flatnonzero(stays)
    candidates = np.flatnonzero(~stays)
    number = draws - len(places)
    cumulative = np.cumsum(weights[candidates])
    levels = (np.arange(number) + rng.random()) / max(number, 1) * cumulative[-1]
    chosen = candidates[np.minimum(np.searchsorted(cumulative, levels, side="right"), len(candidates) - 1)]
    chosen_places = np.concatenate([places, chosen])
    return np.sort(chosen_places), np.concatenate([weights[places], np.full(number, threshold)])[np.argsort(chosen_places, kind="stable")]


def _threshold(weights: Float[np.ndarray, " particle"], draws: int) -> float:
    """Return the c that solves Σ min(w / c, 1) = draws."""
    ordered = np.sort(weights)
    # If all but the k smallest are above the threshold, it is the sum of these k over the draws that are left for them. So many are small that the
    # next larger weight is not.
    smaller = np.cumsum(ordered)[len(weights) - draws :]
    candidates = smaller / np.arange(1, draws + 1)
    following = np.append(ordered[len(weights) - draws + 1 :], np.inf)
    return float(candidates[np.argmax(following >= candidates)])


def _evenly_in_chains(chains: int, length: int, draws: int) -> Int[np.ndarray, " draw"]:
    """Return `draws` evenly spaced places of each chain; the last draw of a chain is one of them."""
    steps = np.ceil(np.arange(1, min(draws, length) + 1) * length / min(draws, length)).astype(int) - 1
    return (length * np.arange(chains)[:, None] + steps).ravel()


def figures_of_all(frame: FrameResult, number: int, spaces: Mapping[str, Space]) -> dict[str, NDArray[Any]]:
    """Return the figures that need all particles of a frame.

    They are `particles`, `ess`, `pareto_k` and `ancestors` (run,), `independent_draws` (), and for each variable `mean_NAME` (run, *shape), the
    weighted mean, and `rhat_NAME` (coordinate,). If there are Markov chains, also `markov_rhat_NAME` (run, coordinate).
    """
    log_weights = frame.log_weights[:, :, None].astype(float)
    weights = weights_of_runs(log_weights)[..., 0]
    centred = {name: around_mean(space, frame.states[name][:, :, None].astype(float), log_weights) for name, space in spaces.items()}
    blocks = {name: Block(range(number, number + 1), poses, log_weights) for name, poses in centred.items()}
    block = Block(range(number, number + 1), np.concatenate(list(centred.values()), axis=-1), log_weights)
    ancestors = [len(np.unique(of_run)) if of_run[0] != NO_ANCESTOR else np.nan for of_run in frame.info.ancestors]
    figures: dict[str, Any] = {
        "particles": np.full(len(weights), weights.shape[1], np.int32),
        "ess": 1 / (weights**2).sum(axis=1),
        "pareto_k": pareto_shape(log_weights[..., 0]),
        "ancestors": np.array(ancestors, float),
        INDEPENDENT: independent_draws(block)[0],
    }
    figures |= {MEAN + name: weighted_mean(frame, name, space) for name, space in spaces.items()}
    figures |= {RHAT + name: rhat_of_block(block)[0] for name, block in blocks.items()}
    if "length" in frame.info.markov:
        length = int(np.max(frame.info.markov["length"]))
        figures |= {MARKOV_RHAT + name: chain_rhat(poses, length)[:, 0] for name, poses in centred.items()}
    return {name: np.asarray(values) for name, values in figures.items()}


def weighted_mean(frame: FrameResult, variable: str, space: Space) -> Float[np.ndarray, "run *shape"]:
    """Return the weighted mean of a variable over all particles of each run, in its space."""
    if MEAN + variable in frame.figures:
        return frame.figures[MEAN + variable]
    weights = np.exp(frame.log_weights - frame.log_weights.max(axis=-1, keepdims=True))
    weights /= weights.sum(axis=-1, keepdims=True)
    return np.asarray(space.mean(weights, frame.states[variable]))
