"""The interface of kernels. A kernel maps the weighted particles of one frame to those of the next, given that frame's density."""

from collections.abc import Mapping
from typing import NamedTuple, Protocol

from jaxtyping import Array

from bayes_body.density.density import Density
from bayes_body.density.factor import Particles
from bayes_body.shapes import Key, Scalar


class FilterInfo(NamedTuple):
    """Diagnostics of one frame of one filter. A kernel that chooses its number of stages pads its per-stage values with NaN.

    Attributes:
        ancestors: for every particle, the index of its ancestor among the particles of the previous frame.
        ess: effective sample size of the final weights, in particles.
        survival_rate: the effective sample size as a fraction of the particles, for each stage (one value if there are no stages).
        inverse_temperatures: the power of the likelihood at each stage.
        log_evidence: log of the estimate of p(z_t | z_1..t-1), nats; NaN from a mode seeker.
        lost: whether no particle explained the frame; the filter then continued from its prediction.
        acceptance_rate: fraction of a stage's Markov moves that were accepted, for each stage; NaN from a kernel without such moves.
        evaluations: number of likelihoods of a whole pose computed for the frame; a likelihood with its gradient counts as one.
        markov: figures of each chain from a kernel that runs Markov chains, (chain,): `acceptance`, `divergences`, `energy_fraction`, `step`; also
            `ess` of each entry of a state, and `length`, the number of draws of a chain. Empty from other kernels.
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


class Kernel(Protocol):
    """Maps the particles of one frame to those of the next, given that frame's density. It is traced once for all frames."""

    def __call__(self, key: Key, particles: Particles, density: Density) -> tuple[Particles, FilterInfo]:
        """Filter one frame."""
        ...
