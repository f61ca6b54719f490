"""The true posterior mean of one frame, from two long independent runs that must agree: of a particle filter, or of many chains.

Which one is better depends on the posterior. If it is hardly narrower than the prediction, millions of particles are worth hundreds of thousands of
draws. If it is far narrower, they are worth a handful, and chains that mix find it (Poon & Fleet 2002 used 4 million particles).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.base.progress import Watch, unwatched, watched
from bayes_body.base.shapes import Key
from bayes_body.density.density import Density
from bayes_body.density.factor import Particles
from bayes_body.density.kernel import FilterInfo
from bayes_body.kernels.hmc.adaptation import FEWEST
from bayes_body.kernels.hmc.hamiltonian import effective_draws
from bayes_body.kernels.hmc.hmc_filter import build_sampler
from bayes_body.kernels.smc.particle_filter import build_kernel
from bayes_body.results.posterior.agreement import split_rhat

# Particles of one program call; millions are summed over many calls.
CHUNK = 50_000
# Largest R-hat of chains that agree: Vehtari et al. (2021).
LARGEST_RHAT = 1.01
# Largest difference between the truth's two runs, relative to the smallest error² that is reported.
LARGEST_DIFFERENCE = 0.1

# Burn-in of a long chain: half as many states as draws, up to this limit.
LONGEST_BURN_IN = 1000
# Options of these chains, whatever the options of the samplers that are compared.
OPTIONS = {"mass": "adapted", "leapfrog_steps": 10, "jitter": 0.3, "step": 0.3, "target_acceptance": 0.7}
# (key, density) -> draws and information.
type Sampler = Callable[[Key, Any], tuple[Particles, FilterInfo]]


class Truth(NamedTuple):
    """A posterior's mean, and how well it is known.

    Attributes:
        mean: mean of each dof, radians and metres.
        sd: standard deviation of each dof.
        error: squared difference of the two runs' means.
        effective: effective number of draws of each run.
        by: `sir` or `hmc`.
        rhat: largest split R-hat over the dofs and over the chains of both runs, even if sir was chosen; NaN if no chains ran.
    """

    mean: Float[np.ndarray, " dof"]
    sd: Float[np.ndarray, " dof"]
    error: Float[np.ndarray, " dof"]
    effective: float
    by: str = "sir"
    rhat: float = float("nan")

    @property
    def converged(self) -> bool:
        """Whether the chains agree, if the truth is theirs."""
        return self.by != "hmc" or self.rhat <= LARGEST_RHAT


def sir_sampler(particles: int) -> Sampler:
    """The particle filter from a fixed mixture, with at least `particles` particles: equally many from each component."""
    kernel = build_kernel()

    def sample(key: Key, density: Density) -> tuple[Particles, FilterInfo]:
        # The kernel draws as many particles as it is given.
        copies = -(-particles // density.previous.log_weights.shape[0])
        return kernel(key, jax.tree.map(lambda leaf: jnp.tile(leaf, (copies,) + (1,) * (leaf.ndim - 1)), density.previous), density)

    return sample


def true_mean(key: Key, density: Density, particles: int, watch: Watch = unwatched) -> Truth:
    """Estimate the mean by two particle filters with `particles` particles each, in chunks."""
    sample = sir_sampler(CHUNK)

    @jax.jit
    def chunk(key: Key, density: Density) -> tuple[Array, Array, Array, Array]:
        draws, info = sample(key, density)
        weights = jnp.exp(draws.log_weights)
        pose = draws.states["pose"]
        return info.log_evidence, weights @ pose, weights @ pose**2, info.ess

    chunks = max(-(-particles // CHUNK), 1)
    halves: list[list[Any]] = [[], []]
    for number in watch(range(2 * chunks)):
        chunk_key = jax.random.fold_in(jax.random.fold_in(key, number % 2), number // 2)
        halves[number % 2].append(jax.device_get(chunk(chunk_key, density)))
    means, squares, effective = zip(*(_pooled(half) for half in halves), strict=True)
    mean = np.mean(means, axis=0)
    return Truth(mean, np.sqrt(np.mean(squares, axis=0) - mean**2), (means[0] - means[1]) ** 2, float(min(effective)))


def _pooled(chunks: list[tuple[Any, ...]]) -> tuple[np.ndarray, np.ndarray, float]:
    evidence, means, squares, effective = (np.array(column, float) for column in zip(*chunks, strict=True))
    # A chunk is weighted by its evidence.
    share = np.exp(evidence - evidence.max())
    share /= share.sum()
    return share @ means, share @ squares, float(1 / np.sum(share**2 / effective))


def true_mean_by_chains(key: Key, density: Density, draws: int, chains: int = 32, starts: int = 200_000, watch: Watch = unwatched) -> Truth:
    """Estimate the mean by two runs of chains. Their starts are drawn from weighted predictions, so modes start with their probabilities.

    Args:
        key: for both runs.
        density: the frame's density.
        draws: draws of each chain after its burn-in.
        chains: chains of each run.
        starts: number of predictions of each run.
        watch: wraps the iteration over runs, to show progress.
    """
    sample = build_sampler(chains=chains, starts=starts, burn_in=min(max(draws // 2, FEWEST), LONGEST_BURN_IN), **OPTIONS)
    run = jax.jit(lambda key, density: sample(key, density, chains * draws)[0].states["pose"])
    halves = [np.asarray(run(jax.random.fold_in(key, half), density), float).reshape(chains, draws, -1) for half in watch(range(2))]
    means, together = [half.mean(axis=(0, 1)) for half in halves], np.concatenate(halves)
    effective = min(float(np.min(effective_draws(jnp.asarray(half)))) for half in halves)
    rhat = float(np.nanmax(split_rhat(together[None])))
    return Truth(together.mean(axis=(0, 1)), together.std(axis=(0, 1)), (means[0] - means[1]) ** 2, effective, "hmc", rhat)


def best_truth(key: Key, density: Density, particles: int, draws: int, bar: bool = False) -> Truth:
    """The better estimate, by particles or by chains; with `bar`, progress is shown on standard error."""
    by_particles = true_mean(key, density, particles, watched("chunks of the truth", bar))
    return better_of(by_particles, true_mean_by_chains(key, density, draws, watch=watched("long runs of hmc", bar)))


def better_of(particles: Truth, chains: Truth) -> Truth:
    """The one with more effective draws; chains that disagree have few."""
    return chains if chains.effective > particles.effective else particles._replace(rhat=chains.rhat)
