r"""Estimator error along the frames of a recording, split into bias and variance (Poon & Fleet 2002, 5.2, Fig. 9).

Each run filters the same frames from the same particles. After each frame its estimate is the posterior mean of each dof. Over independent runs the
error splits exactly,

$$\frac{1}{R} \sum_r (\hat\mu_r - \mu)^2 = (\bar\mu - \mu)^2 + \frac{1}{R} \sum_r (\hat\mu_r - \bar\mu)^2,$$

into bias² and variance. All are in units of the true posterior's variance of that dof and frame: n independent draws have a variance of 1/n. A bias²
below 1/R times the variance cannot be distinguished from 0. The truth comes from two long runs of the chain-based filter that carries all draws.
"""

import time
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from true_mean import OPTIONS

from bayes_body.base.progress import Watch, unwatched, watched
from bayes_body.base.shapes import Key
from bayes_body.density.density import Density
from bayes_body.density.factor import Particles
from bayes_body.density.kernel import Kernel
from bayes_body.kernels.hmc.hmc_filter import build_kernel as hmc_kernel

# For a run that estimates the truth: chains, total draws, and predictions from which the chains' starts are drawn.
CHAINS, DRAWS, STARTS = 16, 1600, 20_000
# For each of these chains: burn-in states, and states per draw.
BURN_IN, THINNING = 100, 3
BOOTSTRAPS = 1000
# Largest squared difference of the truth's two runs, relative to the smallest error² of any filter.
LARGEST_DIFFERENCE = 0.1


class Paths(NamedTuple):
    """Posterior means and variances of independent runs along frames; density evaluations and seconds per frame, without compilation."""

    means: Float[np.ndarray, "run frame dof"]
    variances: Float[np.ndarray, "run frame dof"]
    evaluations: float
    seconds: float


class TruePath(NamedTuple):
    """The posterior's mean and variance after each frame, and the squared difference between the means of two runs."""

    mean: Float[np.ndarray, "frame dof"]
    variance: Float[np.ndarray, "frame dof"]
    error: Float[np.ndarray, "frame dof"]


class Errors(NamedTuple):
    """For each dof after each frame, in units of the true posterior's variance: bias², variance, and their sum."""

    bias: Float[np.ndarray, "frame dof"]
    variance: Float[np.ndarray, "frame dof"]
    error: Float[np.ndarray, "frame dof"]


def follow(key: Key, densities: Sequence[Density], first: Particles, kernel: Kernel, particles: int, runs: int, watch: Watch = unwatched) -> Paths:
    """Independent runs of a filter, one after the other, each with the whole machine. Compilation happens before the clock starts.

    Args:
        key: for all runs.
        densities: those of the frames, in order. Their particles are replaced by those of each run.
        first: the mixture before the first frame.
        kernel: the filter.
        particles: least number of particles of each run.
        runs: number of runs.
        watch: wraps the iteration over runs, to show progress.
    """

    @jax.jit
    def step(key: Key, before: Particles, density: Density) -> tuple[Particles, tuple[Array, Array, Array]]:
        after, info = kernel(key, before, density)
        weights, pose = jnp.exp(after.log_weights), after.states["pose"]
        mean = weights @ pose
        return after, (mean, weights @ (pose - mean) ** 2, info.evaluations)

    begin = _replicated(first, particles)
    jax.block_until_ready(step(key, begin, densities[0]))
    estimates, start = [], time.perf_counter()
    for run in watch(range(runs)):
        run_key, before = jax.random.fold_in(key, run), begin
        for number, density in enumerate(densities):
            before, estimate = step(jax.random.fold_in(run_key, number), before, density)
            estimates.append(jax.device_get(estimate))
    seconds = (time.perf_counter() - start) / len(estimates)
    means, variances, evaluations = (np.array(column, float) for column in zip(*estimates, strict=True))
    shape = runs, len(densities), -1
    return Paths(means.reshape(shape), variances.reshape(shape), float(evaluations.mean()), seconds)


def true_path(
    key: Key, densities: Sequence[Density], first: Particles, draws: int = DRAWS, starts: int = STARTS, watch: Watch = unwatched
) -> TruePath:
    """Estimate the truth by two long runs of chains that carry on all their draws; `draws` is the total of each."""
    kernel = hmc_kernel(**OPTIONS, chains=CHAINS, burn_in=BURN_IN, thinning=THINNING, starts=starts, carry="draws")
    paths = follow(key, densities, first, kernel, draws, 2, watch)
    return TruePath(paths.means.mean(axis=0), paths.variances.mean(axis=0), (paths.means[0] - paths.means[1]) ** 2)


def errors(paths: Paths, truth: TruePath) -> Errors:
    """Bias², variance and their sum, in units of the posterior's variance."""
    bias, variance = (paths.means.mean(axis=0) - truth.mean) ** 2 / truth.variance, paths.means.var(axis=0) / truth.variance
    return Errors(bias, variance, bias + variance)


def along(
    key: Key,
    densities: Sequence[Density],
    first: Particles,
    filters: Mapping[str, tuple[Kernel, int]],
    runs: int,
    draws: int = DRAWS,
    bar: bool = False,
) -> dict[str, Any]:
    """Figures of many runs of each filter along the frames; with `bar`, progress is shown on standard error.

    Args:
        key: for the truth and all runs.
        densities: those of the frames, in order.
        first: the mixture before the first frame.
        filters: by name, a kernel and its number of particles.
        runs: number of runs of each filter.
        draws: of each of the two runs that estimate the truth.
        bar: whether to show progress bars.

    Returns:
        by filter: for each frame the median over dofs of `bias`², `variance` and their sum `error` with its bootstrap interval, in units of the
            posterior's variance; `seconds` and `evaluations` per frame. `truth_difference`: for each frame the difference between the truth's two
            runs, in the same units.
    """
    truth_key, own_key = jax.random.split(key)
    truth = true_path(truth_key, densities, first, draws, watch=watched("long runs along the frames", bar))
    by_filter = {}
    for number, (name, (kernel, particles)) in enumerate(filters.items()):
        watch = watched(f"runs of {name} along the frames", bar)
        by_filter[name] = path_figures(follow(jax.random.fold_in(own_key, number), densities, first, kernel, particles, runs, watch), truth)
    return by_filter | {"truth_difference": _median(truth.error / truth.variance)}


def path_figures(paths: Paths, truth: TruePath, seed: int = 0) -> dict[str, Any]:
    """The figures of one filter."""
    rng, runs = np.random.default_rng(seed), len(paths.means)
    squared = (paths.means - truth.mean) ** 2 / truth.variance
    drawn = [np.median(squared[rng.integers(0, runs, runs)].mean(axis=0), axis=1) for _ in range(BOOTSTRAPS)]
    low, high = np.quantile(drawn, [0.025, 0.975], axis=0)
    medians = {name: _median(values) for name, values in errors(paths, truth)._asdict().items()}
    interval = np.round(np.stack([low, high], axis=1), 6).tolist()
    return medians | {"error_interval": interval, "seconds": paths.seconds, "evaluations": paths.evaluations}


def along_summary(figures: Mapping[str, Any]) -> str:
    """The figures of `along` in sentences, as means over the frames."""
    lines = []
    for name, frame_figures in figures.items():
        if name == "truth_difference":
            lines.append(f"the two runs of that truth differ by {np.mean(frame_figures):.4f}")
            lines += _unreliable(
                np.array(frame_figures), np.min([row["error"] for filter_name, row in figures.items() if filter_name != name], axis=0)
            )
            continue
        error, bias, variance = (np.mean(frame_figures[key]) for key in ("error", "bias", "variance"))
        frames = f"{len(frame_figures['error'])} frame{'' if len(frame_figures['error']) == 1 else 's'}"
        parts = f"error² {error:.4f} of the posterior's variance, bias² {bias:.4f}, variance {variance:.4f}"
        lines.append(f"along {frames}, {name}: {parts} (medians over dofs), {frame_figures['seconds']:.2f} s per frame")
    return "\n".join(lines)


def _unreliable(difference: Float[np.ndarray, " frame"], smallest: Float[np.ndarray, " frame"]) -> list[str]:
    """A warning if the truth is not known well enough for the smallest error of any filter."""
    unknown = difference > LARGEST_DIFFERENCE * smallest
    if not unknown.any():
        return []
    since = f"from frame {int(np.argmax(unknown))} of these on, counted from 0,"
    remedy = "the errors there are unreliable; leave out --quick, or choose another frame"
    return [f"{since} they differ by more than {LARGEST_DIFFERENCE:.0%} of the smallest error²: {remedy}"]


def _median(by_dof: Float[np.ndarray, "frame dof"]) -> list[float]:
    return np.round(np.median(by_dof, axis=1), 6).tolist()


def _replicated(mixture: Particles, particles: int) -> Particles:
    """An equally weighted mixture with at least `particles` particles: each component occurs equally often, with its copies next to each other."""
    copies = -(-particles // mixture.log_weights.shape[0])
    return Particles(
        jax.tree.map(lambda leaf: jnp.repeat(leaf, copies, axis=0), dict(mixture.states)), jnp.repeat(mixture.log_weights, copies) - jnp.log(copies)
    )
