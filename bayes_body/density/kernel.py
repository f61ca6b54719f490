"""What a kernel is: from the weighted particles of one frame to those of the next, given that frame's density."""

from collections.abc import Mapping
from typing import NamedTuple, Protocol

from jaxtyping import Array

from bayes_body.density.density import Density
from bayes_body.density.factor import Particles
from bayes_body.shapes import Key, Scalar


class FilterInfo(NamedTuple):
    """Figures of one frame of one filter, for a reader. A kernel that chooses its number of stages pads values that are one a stage with NaN.

    Attributes:
        ancestors: for every particle, its index among the particles of the frame before.
        ess: effective sample size of the final weights, in particles.
        survival_rate: the effective sample size as a share of the particles; one value a stage (one value if there are no stages).
        inverse_temperatures: the power of the likelihood at each stage.
        log_evidence: log of the estimate of p(z_t | z_1..t-1), nats; NaN from a mode seeker.
        lost: no particle explained the frame; the filter went on from its prediction.
        acceptance_rate: share of a stage's Markov moves that were accepted, one value a stage; NaN from a kernel without such moves.
        evaluations: likelihoods of a whole pose that the frame took; one with its gradient counts as one.
        markov: of a kernel that runs Markov chains, figures of each, (chain,): `acceptance`, `divergences`, `energy_fraction`, `step`; also `ess` of
            each entry of a state, and `length`, the draws of a chain. Empty from any other kernel.
    """

    ancestors: Array
    ess: Scalar
    survival_rate: Array
    inverse_temperatures: Array
    log_evidence: Scalar
    lost: Array
    acceptance_rate: Array
    evaluations: Array
    markov: Mapping[str, Array] = {}  # nobody writes to it


class Kernel(Protocol):
    """From the particles of one frame to those of the next, given that frame's density; traced once for all frames."""

    def __call__(self, key: Key, particles: Particles, density: Density) -> tuple[Particles, FilterInfo]:
        """One frame."""
        ...
