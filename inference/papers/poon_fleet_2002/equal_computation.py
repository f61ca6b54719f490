r"""Estimator variance of two samplers at equal computation (Poon & Fleet 2002, 5.2, Fig. 8).

Both sample one frame, with one fixed prediction mixture. An estimate is a run's posterior mean of each dof. Its error is the mean squared deviation
from the true posterior mean over independent runs, $\frac{1}{R} \sum_r (\hat\mu_r - \mu)^2$. The true mean is known by two independent runs
(`true_mean`), so the error is estimated by $\frac{1}{R} \sum_r (\hat\mu_r - \mu_1)(\hat\mu_r - \mu_2)$, to which their noise adds nothing on
average. A particle costs one likelihood evaluation; a gradient costs as many as were measured.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from true_mean import LARGEST_NOISE, LARGEST_RHAT, Sampler, Truth, sir_sampler

from bayes_body.base.progress import Watch, unwatched, watched
from bayes_body.base.shapes import Key
from bayes_body.density.density import Density
from bayes_body.density.factor import Particles
from bayes_body.kernels.batching import everywhere, over_particles
from bayes_body.kernels.hmc.hmc_filter import build_sampler as hmc_sampler
from bayes_body.kernels.weights import resampler
from bayes_body.model.body.placed_body import require
from bayes_body.model.body.placement import POSE
from bayes_body.tracking.draws import Draws

BOOTSTRAPS = 2000
TIMED = 8


class Runs(NamedTuple):
    """Estimates of independent runs; density evaluations and seconds per run, without compilation."""

    means: Float[np.ndarray, "run dof"]
    evaluations: float
    seconds: float


class Ratios(NamedTuple):
    """Ratio of the mean squared errors of two samplers: for each dof with its 95 % bootstrap interval, and the median over dofs with its interval."""

    per_dof: Float[np.ndarray, "dof 3"]
    median: float
    interval: tuple[float, float]


class Equal(NamedTuple):
    """Runs of hmc, and of sir at equal computation: at equal `evaluations`, and `seconds` if asked. Each has runs and a number of particles."""

    hmc: Runs
    sir: dict[str, Runs]
    particles: dict[str, int]
    gradient_cost: float


def mixture_after(key: Key, draws: Draws, components: int, frame: int = -1) -> Particles:
    """Equally weighted particles of the first run's last frame, or of another one: a prediction mixture (14) for both samplers.

    Raises:
        InputError: the body is placed by its parts; means of joint angles are compared.
    """
    require(draws.model.body, POSE, "a comparison of mean joint angles", "a model of a body that is placed by angles")
    last = draws.frames[frame]
    particles = Particles({name: jnp.asarray(values[0]) for name, values in last.states.items()}, jnp.asarray(last.log_weights[0]))
    chosen = resampler("systematic")(key, particles.log_weights, components)
    states = jax.tree.map(lambda leaf: leaf[chosen], dict(particles.states))
    return Particles(states, jnp.full((components,), -jnp.log(components), particles.log_weights.dtype))


def run_many(key: Key, density: Density, sampler: Sampler, runs: int, watch: Watch = unwatched) -> Runs:
    """Independent runs of a sampler, one after the other, each with the whole machine. The first run, which compiles, is not included."""

    @jax.jit
    def once(key: Key, density: Density) -> tuple[Array, Array]:
        particles, info = sampler(key, density)
        return jnp.exp(particles.log_weights) @ particles.states["pose"], info.evaluations

    jax.block_until_ready(once(jax.random.fold_in(key, runs), density))
    means, evaluations, start = [], [], time.perf_counter()
    for run in watch(range(runs)):
        mean, used = jax.device_get(once(jax.random.fold_in(key, run), density))
        means.append(mean)
        evaluations.append(int(used))
    return Runs(np.array(means, float), float(np.mean(evaluations)), (time.perf_counter() - start) / runs)


def at_equal_computation(
    key: Key, density: Density, options: Mapping[str, Any], draws: int, runs: int, bar: bool = False, cost: float | None = None
) -> Equal:
    """Both samplers on one frame after one mixture; with `bar`, progress is shown on standard error.

    Args:
        key: for all runs.
        density: the frame's density, after the mixture.
        options: options of hmc.
        draws: draws of a run of hmc.
        runs: number of runs of each sampler.
        bar: whether to show progress bars.
        cost: of a gradient, in evaluations, if it has been measured; then nothing depends on a clock, and there are no runs at equal seconds.
    """
    sampler, keys = hmc_sampler(**options), jax.random.split(key, 3)
    timed, cost = cost is None, gradient_cost(density) if cost is None else cost

    def sir(key: Key, particles: int) -> Runs:
        return run_many(key, density, sir_sampler(particles), runs, watched(f"runs of sir, {particles} particles", bar))

    hmc = run_many(keys[0], density, lambda key, density: sampler(key, density, draws), runs, watched("runs of hmc", bar))
    particles = {"evaluations": round(hmc.evaluations * cost)}
    sir_runs = {"evaluations": sir(keys[1], particles["evaluations"])}
    if not timed:
        return Equal(hmc, sir_runs, particles, cost)
    particles["seconds"] = max(round(particles["evaluations"] * hmc.seconds / sir_runs["evaluations"].seconds), 1)
    return Equal(hmc, sir_runs | {"seconds": sir(keys[2], particles["seconds"])}, particles, cost)


def gradient_cost(density: Density, batch: int = 512) -> float:
    """The cost of a value with its gradient, in units of a value's cost, both for many poses at once."""
    previous = everywhere(density.previous)
    poses = jnp.repeat(previous.states["pose"], -(-batch // previous.states["pose"].shape[0]), axis=0)[:batch]

    def value(pose: Array, density: Density) -> Array:
        return density.log_likelihood({"pose": pose}, density.ancestor(0))

    def seconds(function: Callable[..., Any]) -> float:
        program = jax.jit(lambda poses, density: over_particles(function, poses, density))
        jax.block_until_ready(program(poses, density))
        best = np.inf
        for _ in range(TIMED):
            start = time.perf_counter()
            jax.block_until_ready(program(poses, density))
            best = min(best, time.perf_counter() - start)
        return best

    return seconds(jax.value_and_grad(value)) / seconds(value)


def ratios(over: Runs, under: Runs, truth: Truth, seed: int = 0) -> Ratios:
    """The mean squared error of `over` divided by that of `under`. Intervals come from resampling runs, and from the noise of the truth.

    An error² below the noise of the truth counts as that noise, so that no ratio is due to a truth that is too rough.
    """
    rng = np.random.default_rng(seed)

    def ratio(first: np.ndarray, second: np.ndarray, known: Truth) -> np.ndarray:
        errors = (known.squared_errors(runs.means[chosen]).mean(axis=0) for runs, chosen in ((over, first), (under, second)))
        over_error, under_error = (np.maximum(error, np.maximum(truth.noise, np.finfo(float).tiny)) for error in errors)
        return over_error / under_error

    first, second = len(over.means), len(under.means)
    whole = ratio(np.arange(first), np.arange(second), truth)
    drawn = np.empty((BOOTSTRAPS, len(whole)))
    for number in range(BOOTSTRAPS):
        known = truth._replace(halves=truth.halves + np.sqrt(truth.noise) * rng.normal(size=truth.halves.shape))
        drawn[number] = ratio(rng.integers(0, first, first), rng.integers(0, second, second), known)
    low, high = np.quantile(drawn, [0.025, 0.975], axis=0)
    medians = np.median(drawn, axis=1)
    interval = tuple(float(q) for q in np.quantile(medians, [0.025, 0.975]))
    return Ratios(np.stack([whole, low, high], axis=1), float(np.median(whole)), (interval[0], interval[1]))


def figures_of(names: Sequence[str], equal: Equal, truth: Truth) -> dict[str, Any]:
    """Ratios and costs at equal evaluations, the same for `equal_seconds` if there are such runs, and the `settings`, as plain numbers."""
    rows = {cost: _row(names, runs, equal.hmc, truth) for cost, runs in equal.sir.items()}
    known = {"truth_by": truth.by, "truth_rhat": truth.rhat, "truth_effective": truth.effective, "truth_noise": relative_noise(equal.hmc, truth)}
    known["truth_converged"] = truth.converged
    return {
        **rows["evaluations"],
        **({"equal_seconds": rows["seconds"]} if "seconds" in rows else {}),
        "settings": {"gradient_cost": equal.gradient_cost, "particles_sir": equal.particles, **known},
    }


def relative_noise(runs: Runs, truth: Truth) -> float:
    """Return the variance of a run of the truth, relative to the error² of some runs, of the dof where it is largest."""
    error = np.maximum(truth.squared_errors(runs.means).mean(axis=0), np.maximum(truth.noise, np.finfo(float).tiny))
    return float(np.max(truth.noise / error))


def _row(names: Sequence[str], over: Runs, under: Runs, truth: Truth) -> dict[str, Any]:
    error_ratios = ratios(over, under, truth)
    per_dof = dict(zip(names, np.round(error_ratios.per_dof, 4).tolist(), strict=True))
    costs = {"seconds_hmc": under.seconds, "seconds_sir": over.seconds, "evaluations_hmc": under.evaluations, "evaluations_sir": over.evaluations}
    return {"ratio_median": error_ratios.median, "ratio_interval": error_ratios.interval, "per_dof": per_dof, **costs}


def summary(figures: Mapping[str, Any]) -> str:
    """The headline of `figures_of` in sentences."""
    settings, lines = figures["settings"], []
    for key, row in {"evaluations": figures, "seconds": figures["equal_seconds"]}.items():
        low, high = row["ratio_interval"]
        median = f"{row['ratio_median']:.2f}, 95 % from {low:.2f} to {high:.2f}"
        lines.append(
            f"at equal {key}: error² of sir ({settings['particles_sir'][key]} particles) over hmc {median}; {row['seconds_hmc']:.2f} s per run of hmc"
        )
    rhat = f"R-hat of long chains {settings['truth_rhat']:.3f}"
    lines.append(f"the truth was estimated by {settings['truth_by']}, with {settings['truth_effective']:.0f} effective draws, {rhat}")
    lines.append(f"the variance of one of its two runs is at most {settings['truth_noise']:.1%} of hmc's error²")
    if settings["truth_noise"] > LARGEST_NOISE or not settings["truth_converged"]:
        allowed = f"an R-hat above {LARGEST_RHAT} or a variance above {LARGEST_NOISE:.0%} is too much"
        lines.append(f"{allowed}: these ratios are meaningless; leave out --quick, or choose a frame whose posterior has one mode")
    return "\n".join(lines)
