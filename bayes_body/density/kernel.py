"""The interface of kernels. A kernel maps the weighted particles of one frame to those of the next, given that frame's density."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import jax
from jaxtyping import Array
from pydantic import BaseModel

from bayes_body.base.shapes import Flag, Key, Scalar
from bayes_body.density.density import Density
from bayes_body.density.factor import Particles

# Replaces the index of an ancestor where particles have none: after a prediction by a Gaussian, or on the paths of a smoother.
NO_ANCESTOR = -1


class FilterInfo(NamedTuple):
    """Diagnostics of one frame of one filter. A kernel that chooses its number of stages pads its per-stage values with NaN.

    Attributes:
        ancestors: for every particle, the index of its ancestor among the particles of the previous frame; NO_ANCESTOR if it has none.
        ess: effective sample size of the final weights, in particles.
        survival_rate: the effective sample size as a fraction of the particles, for each stage (one value if there are no stages).
        inverse_temperatures: the power of the likelihood at each stage.
        log_evidence: log of the estimate of p(z_t | z_1..t-1), nats; NaN from a mode seeker.
        lost: whether no particle explained the frame; the filter then continued from its prediction.
        acceptance_rate: fraction of a stage's Markov moves that were accepted, for each stage; NaN from a kernel without such moves.
        evaluations: number of likelihoods of a whole pose computed for the frame; a likelihood with its gradient counts as one.
        markov: figures of each chain from a kernel that runs Markov chains, (chain,): `acceptance`, `divergences`, `energy_fraction`, `step`; also
            `ess` of each entry of a state, and `length`, the number of draws of a chain. Empty from other kernels.
        messages: figures of a kernel that passes messages on a graph (formulas: kernels/messages/messages.py). Empty from other kernels.
            `samples`: number of particles of a node.
            `belief_ess` (node,): effective sample size, 1 / sum of w², of every belief after the last iteration.
            `message_ess`: the smallest effective sample size of all messages after the last iteration.
            `message_change` (iteration, node): how far a belief's mean moved, in its standard deviations, root mean square over the tangent
            coordinates; NaN in the first iteration.
            `belief_sd` (iteration, node, tangent coordinate): these standard deviations.
            `oscillation` (node,): how far the mean jumped back in the last iteration, in standard deviations; NaN with fewer than three iterations.
            `joint_ess`: effective sample size of the joint draws.
            `proposal_shares` (node, 4): shares of messages, prior, detections and normal fit in the weight of a node's particles.
        modes: figures of the kernel `laplace`. Empty from other kernels.
            `attempt`: how the frame was done at last: 0 at first, 1 again from more starts, 2 by the kernel `tempered`.
            `steps`: number of steps of the searches for modes.
            `modes`: number of distinct modes that compete.
            `pareto_k`: tail shape of the weights of the last attempt by importance sampling; NaN if they are nearly equal.
        joint: figures of paths that are drawn from one Gaussian of all frames (kernels/paths/joint/path.py). Empty from other ways.
            `steps`: number of steps of the search.
            `converged`: whether the search ended before its largest number of steps.
            `pareto_k`: tail shape of the weights of the window about the frame; -∞ if they are nearly equal, NaN with too few draws.
            `near_limit` (dof,): whether the mean of a dof is within three standard deviations of its limit.
    """

    ancestors: Array
    ess: Scalar
    survival_rate: Array
    inverse_temperatures: Array
    log_evidence: Scalar
    lost: Array
    acceptance_rate: Array
    evaluations: Array
    markov: Mapping[str, Array] = {}  # never written to
    messages: Mapping[str, Array] = {}  # never written to
    modes: Mapping[str, Array] = {}  # never written to
    joint: Mapping[str, Array] = {}  # never written to


class Kernel(Protocol):
    """A map from the particles of one frame to those of the next, given that frame's density. It is traced once for all frames."""

    def __call__(self, key: Key, particles: Particles, density: Density) -> tuple[Particles, FilterInfo]:
        """Filter one frame."""
        ...


@dataclass(frozen=True, eq=False)
class KernelWithFallback:
    """A kernel that leaves a frame to another one where it fails.

    As a function it contains both and chooses inside the program. Tracking compiles the other one as a program for itself, once a frame needs it
    (tracking/fallback.py).

    Attributes:
        first: does most frames.
        fails: whether `first` failed, by its figures: arrays of a program, or of NumPy with any leading axes.
        fallback: does a frame in which `first` fails, from the same key, particles and density. Its figures have the same shapes; those in its
            mappings replace the ones of `first`.
    """

    first: Kernel
    fails: Callable[[FilterInfo], Flag]
    fallback: Kernel

    def __call__(self, key: Key, particles: Particles, density: Density) -> tuple[Particles, FilterInfo]:
        """Filter one frame."""

        def redo(failed: Particles, info: FilterInfo) -> tuple[Particles, FilterInfo]:
            del failed
            redone, redone_info = self.fallback(key, particles, density)
            return redone, done_again(info, redone_info)

        filtered, info = self.first(key, particles, density)
        return jax.lax.cond(self.fails(info), redo, lambda *done: done, filtered, info)


def done_again(first: FilterInfo, second: FilterInfo) -> FilterInfo:
    """Return the figures of a frame that a fallback has done, from those of the first kernel and those of the fallback."""
    replaced = {name: {**getattr(first, name), **getattr(second, name)} for name in ("markov", "messages", "modes")}
    return second._replace(evaluations=first.evaluations + second.evaluations, **replaced)


@dataclass(frozen=True, eq=False)
class NamedKernel:
    """A kernel with its name and options, as `Model.kernel` and `bayes_body.kernels.tempered` return it.

    Attributes:
        kind: its name in a definition, such as `tempered`.
        options: its options, validated.
        function: the kernel itself.
    """

    kind: str
    options: BaseModel
    function: Kernel

    def __call__(self, key: Key, particles: Particles, density: Density) -> tuple[Particles, FilterInfo]:
        """Filter one frame."""
        return self.function(key, particles, density)
