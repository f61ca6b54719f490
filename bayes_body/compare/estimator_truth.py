"""The true posterior mean of one frame, by two long independent runs that must agree: of a particle filter, or of many chains.

Which is the better one depends on the posterior: where it is hardly narrower than the prediction, millions of particles are worth hundreds of
thousands of draws; where it is far narrower they are worth a handful, and chains that mix find it (Poon & Fleet 2002 took 4 million particles).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.density.density import Density
from bayes_body.density.factor import Particles
from bayes_body.density.kernel import FilterInfo
from bayes_body.kernels.hmc_filter import build_sampler
from bayes_body.kernels.particle_filter import build_kernel
from bayes_body.kernels.parts.adaptation import FEWEST
from bayes_body.kernels.parts.hamiltonian import effective_draws
from bayes_body.posterior.agreement import split_rhat
from bayes_body.shapes import Key
from bayes_body.view.progress import Watch, unwatched, watched

# Particles of one program; a truth of millions is summed over many.
CHUNK = 50_000
# Chains that agree: Vehtari et al. (2021).
LARGEST_RHAT = 1.01
# Of the smallest error² that is told, by how much two runs for the truth may differ.
LARGEST_DIFFERENCE = 0.1

# The burn-in of a long chain: half as many states as its draws, at most so many.
LONGEST_BURN_IN = 1000
# Of the chains, whatever those of the samplers that are compared.
OPTIONS = {"mass": "adapted", "leapfrog_steps": 10, "jitter": 0.3, "step": 0.3, "target_acceptance": 0.7}
# (key, density) -> draws and information.
type Sampler = Callable[[Key, Any], tuple[Particles, FilterInfo]]


class Truth(NamedTuple):
    """A posterior's mean, and how well it is known.

    Attributes:
        mean: of each dof, radians and metres.
        sd: standard deviation of each dof.
        error: squared difference of the two runs' means.
        effective: draws that each run is worth.
        by: `sir` or `hmc`.
        rhat: largest split R-hat over the dofs and the chains of both runs, also where these were not taken; NaN where none ran.
    """

    mean: Float[np.ndarray, " dof"]
    sd: Float[np.ndarray, " dof"]
    error: Float[np.ndarray, " dof"]
    effective: float
    by: str = "sir"
    rhat: float = float("nan")

    @property
    def converged(self) -> bool:
        """Whether the chains agree, where it is theirs."""
        return self.by != "hmc" or self.rhat <= LARGEST_RHAT


def sir_sampler(particles: int) -> Sampler:
    """The particle filter from a fixed mixture, of so many particles or a few more: of each component equally many."""
    kernel = build_kernel()

    def sample(key: Key, density: Density) -> tuple[Particles, FilterInfo]:
        # The kernel draws as many particles as it is given.
        copies = -(-particles // density.previous.log_weights.shape[0])
        return kernel(key, jax.tree.map(lambda leaf: jnp.tile(leaf, (copies,) + (1,) * (leaf.ndim - 1)), density.previous), density)

    return sample


def true_mean(key: Key, density: Density, particles: int, watch: Watch = unwatched) -> Truth:
    """By two particle filters of so many particles each, in chunks."""
    sample = sir_sampler(CHUNK)

    @jax.jit
    def chunk(key: Key, density: Density) -> tuple[Array, Array, Array, Array]:
        found, info = sample(key, density)
        weights = jnp.exp(found.log_weights)
        pose = found.states["pose"]
        return info.log_evidence, weights @ pose, weights @ pose**2, info.ess

    chunks = max(-(-particles // CHUNK), 1)
    halves: list[list[Any]] = [[], []]
    for number in watch(range(2 * chunks)):
        own = jax.random.fold_in(jax.random.fold_in(key, number % 2), number // 2)
        halves[number % 2].append(jax.device_get(chunk(own, density)))
    means, squares, effective = zip(*(_pooled(half) for half in halves), strict=True)
    mean = np.mean(means, axis=0)
    return Truth(mean, np.sqrt(np.mean(squares, axis=0) - mean**2), (means[0] - means[1]) ** 2, float(min(effective)))


def _pooled(chunks: list[tuple[Any, ...]]) -> tuple[np.ndarray, np.ndarray, float]:
    evidence, means, squares, effective = (np.array(each, float) for each in zip(*chunks, strict=True))
    # A chunk counts by its evidence.
    share = np.exp(evidence - evidence.max())
    share /= share.sum()
    return share @ means, share @ squares, float(1 / np.sum(share**2 / effective))


def true_mean_by_chains(key: Key, density: Density, draws: int, chains: int = 32, starts: int = 200_000, watch: Watch = unwatched) -> Truth:
    """By two runs of so many chains each, their starts drawn among so many weighted predictions: modes begin with the shares that they have.

    Args:
        key: of both.
        density: of the frame.
        draws: of each chain, behind its burn-in.
        chains: of each run.
        starts: predictions of each run.
        watch: takes the numbers of the runs and gives them back, as a bar does.
    """
    sample = build_sampler(chains=chains, starts=starts, burn_in=min(max(draws // 2, FEWEST), LONGEST_BURN_IN), **OPTIONS)
    run = jax.jit(lambda key, density: sample(key, density, chains * draws)[0].states["pose"])
    found = [np.asarray(run(jax.random.fold_in(key, half), density), float).reshape(chains, draws, -1) for half in watch(range(2))]
    means, together = [half.mean(axis=(0, 1)) for half in found], np.concatenate(found)
    effective = min(float(np.min(effective_draws(jnp.asarray(half)))) for half in found)
    rhat = float(np.nanmax(split_rhat(together[None])))
    return Truth(together.mean(axis=(0, 1)), together.std(axis=(0, 1)), (means[0] - means[1]) ** 2, effective, "hmc", rhat)


def best_truth(key: Key, density: Density, particles: int, draws: int, bar: bool = False) -> Truth:
    """The better one of so many particles and of chains of so many draws each; with `bar`, both are watched on standard error."""
    by_particles = true_mean(key, density, particles, watched("chunks of the truth", bar))
    return better_of(by_particles, true_mean_by_chains(key, density, draws, watch=watched("long runs of hmc", bar)))


def better_of(particles: Truth, chains: Truth) -> Truth:
    """The one that is worth more draws; chains that disagree are worth few."""
    return chains if chains.effective > particles.effective else particles._replace(rhat=chains.rhat)
