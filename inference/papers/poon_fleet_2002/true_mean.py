"""The true posterior mean of one frame, from two long independent runs that must agree: of a particle filter, of many chains, or of tempered chains.

Which one is better depends on the posterior. If it is hardly narrower than the prediction, millions of particles are worth hundreds of thousands of
draws. If it is far narrower, they are worth a handful, and chains that mix find it (Poon & Fleet 2002 used 4 million particles). If it has modes
between which no chain moves, chains of any length disagree. Then tempered SMC with many moves estimates it, whose particles enter the modes by their
probability; a run is weighted by its evidence.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from control_variates import positions_and_scores, steadied
from jaxtyping import Array, Float

from bayes_body.base.progress import Watch, unwatched, watched
from bayes_body.base.shapes import Key
from bayes_body.density.density import Density
from bayes_body.density.factor import Particles
from bayes_body.density.kernel import FilterInfo
from bayes_body.kernels.hmc.adaptation import FEWEST
from bayes_body.kernels.hmc.hamiltonian import effective_draws
from bayes_body.kernels.hmc.hmc_filter import build_sampler
from bayes_body.kernels.smc import tempered_smc
from bayes_body.kernels.smc.particle_filter import build_kernel
from bayes_body.results.posterior.agreement import split_rhat

# Particles of one program call; millions are summed over many calls.
CHUNK = 50_000
# Largest R-hat of chains that agree: Vehtari et al. (2021).
LARGEST_RHAT = 1.01
# Largest variance of the mean of one of the truth's two runs, relative to the smallest error² that is reported.
LARGEST_NOISE = 0.1

# Burn-in of a long chain: half as many states as draws, up to this limit.
LONGEST_BURN_IN = 1000
# Predictions from which the starts of these chains are drawn.
STARTS = 200_000
# Options of these chains, whatever the options of the samplers that are compared.
OPTIONS = {"mass": "adapted", "leapfrog_steps": 10, "jitter": 0.3, "step": 0.3, "target_acceptance": 0.7}
# Options of tempered SMC, if it estimates the truth.
TEMPERED = {"moves": 4, "leapfrog_steps": 6, "target_ess": 0.8}
# (key, density) -> draws and information.
type Sampler = Callable[[Key, Any], tuple[Particles, FilterInfo]]


class Truth(NamedTuple):
    """A posterior's mean, and how well it is known.

    Attributes:
        halves: mean of each dof by each of two independent runs, radians and metres.
        sd: standard deviation of each dof.
        noise: variance of the mean of a run, as its chains, groups or particles tell.
        effective: effective number of draws of each run.
        by: `sir`, `hmc` or `tempering`.
        rhat: largest split R-hat over the dofs and over the chains of both runs, even if sir was chosen; NaN if no chains ran. By tempering, it is
            that of independent runs (`group_rhat`).
    """

    halves: Float[np.ndarray, "2 dof"]
    sd: Float[np.ndarray, " dof"]
    noise: Float[np.ndarray, " dof"]
    effective: float
    by: str = "sir"
    rhat: float = float("nan")

    @property
    def mean(self) -> Float[np.ndarray, " dof"]:
        """The mean of both runs."""
        return self.halves.mean(axis=0)

    def squared_errors(self, means: Float[np.ndarray, "run dof"]) -> Float[np.ndarray, "run dof"]:
        """Return estimates of the squared errors of some means. On average they are right: noise of the truth does not add to them.

        They are products of the deviations from both runs of the truth, whose errors are independent. So one of them may be negative.
        """
        return (means - self.halves[0]) * (means - self.halves[1])

    @property
    def converged(self) -> bool:
        """Whether the chains agree, if the truth is theirs."""
        return self.by == "sir" or self.rhat <= LARGEST_RHAT


def sir_sampler(particles: int) -> Sampler:
    """The particle filter from a fixed mixture, with at least `particles` particles: equally many from each component."""
    kernel = build_kernel()

    def sample(key: Key, density: Density) -> tuple[Particles, FilterInfo]:
        # The kernel draws as many particles as it is given.
        return kernel(key, copied(density.previous, particles), density)

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
    variance = np.mean(squares, axis=0) - np.mean(means, axis=0) ** 2
    return Truth(np.array(means), np.sqrt(variance), variance / min(effective), float(min(effective)))


def _pooled(chunks: list[tuple[Any, ...]]) -> tuple[np.ndarray, np.ndarray, float]:
    evidence, means, squares, effective = (np.array(column, float) for column in zip(*chunks, strict=True))
    # A chunk is weighted by its evidence.
    share = np.exp(evidence - evidence.max())
    share /= share.sum()
    return share @ means, share @ squares, float(1 / np.sum(share**2 / effective))


def true_mean_by_chains(key: Key, density: Density, draws: int, chains: int = 32, starts: int = STARTS, watch: Watch = unwatched) -> Truth:
    """Estimate the mean by two runs of chains. Their starts are drawn from weighted predictions, so modes start with their probabilities.

    The gradients at the draws take most of the noise out of the means (control_variates.py). R-hat and the effective draws are those of the chains.

    Args:
        key: for both runs.
        density: the frame's density.
        draws: draws of each chain after its burn-in.
        chains: chains of each run.
        starts: number of predictions of each run.
        watch: wraps the iteration over runs, to show progress.
    """
    sample = build_sampler(chains=chains, starts=starts, burn_in=min(max(draws // 2, FEWEST), LONGEST_BURN_IN), **OPTIONS)
    run = jax.jit(lambda key, density: sample(key, density, chains * draws)[0].states)
    # Waited for, so that the bar tells what is done.
    states = [jax.block_until_ready(run(jax.random.fold_in(key, half), density)) for half in watch(range(2))]
    poses = [np.asarray(of_half["pose"], float) for of_half in states]
    gradients = [jax.device_get(positions_and_scores(of_half, density)) for of_half in states]
    by_chain = np.array([of_half.reshape(chains, draws, -1).mean(axis=1) for of_half in steadied(poses, *zip(*gradients, strict=True))])
    halves, together = [pose.reshape(chains, draws, -1) for pose in poses], np.concatenate(poses)
    effective = min(float(np.min(effective_draws(jnp.asarray(half)))) for half in halves)
    rhat = float(np.nanmax(split_rhat(np.concatenate(halves)[None])))
    noise = by_chain.var(axis=1, ddof=1).mean(axis=0) / chains
    return Truth(by_chain.mean(axis=1), together.std(axis=0), noise, effective, "hmc", rhat)


class Groups(NamedTuple):
    """The moments of independent runs of tempered SMC."""

    log_evidence: Float[np.ndarray, " group"]
    means: Float[np.ndarray, "group dof"]
    squares: Float[np.ndarray, "group dof"]

    @property
    def share(self) -> Float[np.ndarray, " group"]:
        """The share of each run in the whole, by its evidence."""
        share = np.exp(self.log_evidence - self.log_evidence.max())
        return share / share.sum()

    def pooled(self) -> tuple[Float[np.ndarray, " dof"], Float[np.ndarray, " dof"], Float[np.ndarray, " dof"]]:
        """Return the mean and variance of all runs, weighted by evidence, and the variance of a run's mean about it."""
        share, mean = self.share, self.share @ self.means
        # Of independent runs with unequal weights, 1 - sum(share²) is the expected share of a run's variance about the weighted mean.
        between = share @ (self.means - mean) ** 2 / max(1 - np.sum(share**2), np.finfo(float).eps)
        return mean, share @ self.squares - mean**2, between

    @property
    def noise(self) -> Float[np.ndarray, " dof"]:
        """The variance of the mean of all runs together."""
        return self.pooled()[2] * np.sum(self.share**2)

    @property
    def effective(self) -> float:
        """Effective draws of all runs together: those of the dof about whose mean they agree least."""
        # A dof on which all runs agree is known exactly.
        return float(1 / np.max(self.noise / self.pooled()[1]))


def group_rhat(groups: Groups) -> float:
    """Return the largest R-hat over the dofs of independent runs (nested R-hat of Margossian et al. 2024).

    The variance between runs is compared with that inside a run, which has particles in all modes. Runs agree if their modes have the same shares.
    """
    _, variance, between = groups.pooled()
    return float(np.sqrt(1 + np.max(between / np.maximum(variance - between, np.finfo(float).tiny))))


def true_mean_by_tempering(key: Key, density: Density, particles: int = 2048, groups: int = 12, watch: Watch = unwatched) -> Truth:
    """Estimate the mean by independent runs of tempered SMC with many moves; they take turns between the truth's two halves.

    Particles enter the modes by their probability, while the likelihood still counts little. That takes more moves than tracking does (TEMPERED).

    Args:
        key: for all runs.
        density: the frame's density.
        particles: of a run.
        groups: number of runs, at least four.
        watch: wraps the iteration over runs, to show progress.
    """
    kernel = tempered_smc.build_kernel(**TEMPERED)

    @jax.jit
    def moments(key: Key, density: Density) -> tuple[Array, Array, Array]:
        drawn, info = kernel(key, copied(density.previous, particles), density)
        weights, pose = jnp.exp(drawn.log_weights), drawn.states["pose"]
        return info.log_evidence, weights @ pose, weights @ pose**2

    runs = [jax.device_get(moments(jax.random.fold_in(key, number), density)) for number in watch(range(groups))]
    every = Groups(*(np.array(column, float) for column in zip(*runs, strict=True)))
    sides = [Groups(*(column[side::2] for column in every)) for side in range(2)]
    halves, noise = np.array([side.pooled()[0] for side in sides]), 2 * every.noise
    return Truth(halves, np.sqrt(every.pooled()[1]), noise, every.effective / 2, "tempering", group_rhat(every))


def copied(mixture: Particles, least: int) -> Particles:
    """Return a mixture of equal components with at least so many particles, equally many from each."""
    copies = -(-least // mixture.log_weights.shape[0])
    return jax.tree.map(lambda leaf: jnp.tile(leaf, (copies,) + (1,) * (leaf.ndim - 1)), mixture)


def best_truth(key: Key, density: Density, particles: int, draws: int, bar: bool = False, starts: int = STARTS) -> Truth:
    """The better estimate, by particles or by chains (`true_mean_by_chains`); with `bar`, progress is shown on standard error."""
    by_particles = true_mean(key, density, particles, watched("chunks of the truth", bar))
    return better_of(by_particles, true_mean_by_chains(key, density, draws, starts=starts, watch=watched("long runs of hmc", bar)))


def better_of(particles: Truth, chains: Truth) -> Truth:
    """The one with more effective draws; chains that disagree have few."""
    return chains if chains.effective > particles.effective else particles._replace(rhat=chains.rhat)
