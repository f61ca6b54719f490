"""Frames of independent runs as one frame: each run is a chain of its own, with its draws, weights and figures unchanged.

R-hat and the number of independent draws compare the runs, so they are computed anew. If the runs are thinned, most of their particles are gone. The
mean of all particles of a run is stored (`posterior.thinning`): the run's draws are moved by the difference to it, so that thinning does not make the
runs look as if they disagreed.
"""

from collections.abc import Mapping, Sequence

import jax
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from bayes_body.density.spaces import Space
from bayes_body.results.posterior.agreement import independent_draws, rhat_of_block
from bayes_body.results.posterior.blocks import Block, pooled, weights_of_runs
from bayes_body.results.posterior.message_passing import DIMS
from bayes_body.results.posterior.thinning import INDEPENDENT, MEAN, RHAT
from bayes_body.tracking.draws import FrameResult


def joined(frames: Sequence[FrameResult], number: int, spaces: Mapping[str, Space]) -> FrameResult:
    """Return one frame with the runs of all. Its seconds are the sum; figures of message passing that a posterior has no place for are left out.

    Args:
        frames: the same frame of each run, of one session, model and kernel.
        number: its number, which gives each frame its own random numbers.
        spaces: where the variables of its states live.
    """
    infos = [frame.info._replace(messages={name: values for name, values in frame.info.messages.items() if name in DIMS}) for frame in frames]
    states = {name: np.concatenate([frame.states[name] for frame in frames]) for name in frames[0].states}
    log_weights = np.concatenate([frame.log_weights for frame in frames])
    return FrameResult(
        states,
        log_weights,
        jax.tree.map(lambda *leaves: np.concatenate(leaves), *infos),
        frames[0].seen,
        sum(frame.seconds for frame in frames),
        sum(frame.seconds_ready for frame in frames),
        _restarted(frames),
        _figures([frame.figures for frame in frames], states, log_weights, number, spaces),
    )


def _restarted(frames: Sequence[FrameResult]) -> NDArray[np.bool_]:
    """Return whether each run started anew; empty if none did."""
    if not any(frame.restarted.size for frame in frames):
        return np.zeros(0, bool)
    return np.concatenate([frame.restarted if frame.restarted.size else np.zeros(len(frame.log_weights), bool) for frame in frames])


def _figures(
    figures: Sequence[Mapping[str, NDArray]],
    states: Mapping[str, NDArray],
    log_weights: Float[np.ndarray, "run draw"],
    number: int,
    spaces: Mapping[str, Space],
) -> dict[str, NDArray]:
    """Return the figures of all particles of thinned runs (`figures_of_all`); none if the runs are not thinned."""
    if not figures[0]:
        return {}
    by_run = {name: np.concatenate([of_run[name] for of_run in figures]) for name in figures[0] if name != INDEPENDENT and not name.startswith(RHAT)}
    with_frame = log_weights[:, :, None].astype(float)
    blocks = {name: _moved(space, states[name], with_frame, by_run[MEAN + name], number) for name, space in spaces.items()}
    block = Block(range(number, number + 1), np.concatenate([block.poses for block in blocks.values()], axis=-1), with_frame)
    between = {INDEPENDENT: independent_draws(block)[0]} | {RHAT + name: rhat_of_block(block)[0] for name, block in blocks.items()}
    # The order of a thinned run's figures.
    return {name: np.asarray(between.get(name, by_run.get(name))) for name in figures[0]}


def _moved(
    space: Space, points: Float[np.ndarray, "run draw *shape"], log_weights: Float[np.ndarray, "run draw 1"], means: NDArray, number: int
) -> Block:
    """Return the coordinates of the draws around the mean of all, moved so that the weighted mean of each run is that of all its particles."""
    weights, values = weights_of_runs(log_weights), points[:, :, None].astype(float)
    centre = np.asarray(space.mean(pooled(weights) / len(points), pooled(values)))
    coordinates, wanted = (np.asarray(space.coordinates(centre, array), float) for array in (values, means[:, None, None].astype(float)))
    of_draws = np.einsum("rsf,rsfd->rfd", weights, coordinates)[:, None]
    return Block(range(number, number + 1), coordinates + wanted - of_draws, log_weights)
