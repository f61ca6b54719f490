r"""Compare a kernel's posterior over independent runs with grid quadrature, on a session's first frame, for a model that cannot be simulated.

The quadrature integrates a posterior of few dimensions by summation over a grid,

$$\hat\mu = \frac{\sum_g s_g\, e^{\ell(s_g)}}{\sum_g e^{\ell(s_g)}},$$

with the marginal view's $\ell$ at the midpoints $s_g$ of a box. The box starts as the region that the motion prior can reach, inside the joint
limits. A coarse grid shrinks it to the posterior's mass. Then the grid is refined until mean and standard deviation are stable.
"""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.base.errors import input_error
from bayes_body.base.registry import find
from bayes_body.base.shapes import Key
from bayes_body.base.toml.read import validate
from bayes_body.density.density import Density
from bayes_body.density.factor import Particles, State
from bayes_body.density.kernel import Kernel
from bayes_body.model.body.placed_body import require
from bayes_body.model.body.placement import POSE
from bayes_body.model.build import Model
from bayes_body.model.plugins.load import check_own_factors, where_of
from bayes_body.recording.observation.frames import read_frame
from bayes_body.recording.session.read import load_session
from bayes_body.workshop.calibration.scene import check_effective
from bayes_body.workshop.calibration.verdict import Verdict

MOST_DOFS = 4
# Cells per side while the box shrinks, and then for increasingly fine grids.
COARSE, FINE = 13, (13, 17, 23, 31, 41)
# A slice at the box's border with less than this fraction of the mass is cut off. The grid is fine enough if no mean or standard deviation changes by
# more than this, in standard deviations.
NEGLIGIBLE, TOLERANCE = 1e-6, 0.005
PREDICTED, REACH, MOST_DRAWN_IN = 4096, 6.0, 12
BATCH = 2048


type Evaluate = Callable[[np.ndarray], np.ndarray]


class Quadrature(NamedTuple):
    """Mean and standard deviation of each dof of a variable, the difference between the last two grids, and log p(z) up to a constant."""

    mean: Float[np.ndarray, " dof"]
    sd: Float[np.ndarray, " dof"]
    error: Float[np.ndarray, " dof"]
    log_evidence: float
    evaluations: int


def integrate(density: Density, name: str = "pose") -> Quadrature:
    """Integrate the posterior of one frame.

    Args:
        density: its marginal view is integrated.
        name: the only variable that the motion prior draws.

    Raises:
        InputError: too many dofs for a grid.
    """
    low, high = _reachable(density, name)
    if len(low) > MOST_DOFS:
        raise input_error("a grid", f"{len(low)} dofs", f"at most {MOST_DOFS}", "check a smaller body")
    evaluate, count = _evaluator(density, name), 0
    for _ in range(MOST_DRAWN_IN):
        inner, used = _shrunk(evaluate, low, high)
        count += used
        shrunk = np.prod((inner[1] - inner[0]) / (high - low))
        low, high = inner
        if shrunk > 0.8:
            break
    moments = _moments(evaluate, low, high, FINE[0])
    error = np.full(len(low), np.inf)
    for cells in FINE[1:]:
        if (error < TOLERANCE * moments[1]).all():
            break
        previous_moments, moments, count = moments, _moments(evaluate, low, high, cells), count + moments[3]
        error = np.maximum(*(np.abs(estimate - then) for estimate, then in zip(moments[:2], previous_moments[:2], strict=True)))
    mean, sd, log_evidence, used = moments
    return Quadrature(mean, sd, error, log_evidence, count + used)


@jax.jit
def _predicted(density: Density) -> State:
    """Draws of the motion prior from the previous particles."""
    keys = jax.random.split(jax.random.key(0), PREDICTED)
    ancestors = jax.random.categorical(jax.random.key(1), density.previous.log_weights, shape=(PREDICTED,))
    return jax.vmap(lambda key, ancestor: density.transition.sample(key, density.ancestor(ancestor)))(keys, ancestors)


def _reachable(density: Density, name: str) -> tuple[np.ndarray, np.ndarray]:
    """The box that the motion prior reaches from the previous particles, inside its support."""
    values = np.asarray(_predicted(density)[name], float)
    middle, spread = values.mean(axis=0), np.maximum(values.std(axis=0), 1e-9)
    support = density.transition.conditional(density.ancestor(0))[name].support
    low, high = (np.asarray(getattr(support, side, end), float) for side, end in (("low", -np.inf), ("high", np.inf)))
    return np.maximum(middle - REACH * spread, low), np.minimum(middle + REACH * spread, high)


@partial(jax.jit, static_argnames="name")
def _log_densities(points: Float[Array, "batch point dof"], density: Density, name: str) -> Float[Array, "batch point"]:
    """The log-density at values of one variable; the others are those of the first particle."""
    carried = {variable: leaf for variable, leaf in density.ancestor(0).items() if variable != name}
    return jax.lax.map(jax.vmap(lambda point: density({**carried, name: point})), points)


def _evaluator(density: Density, name: str) -> Evaluate:
    def evaluate(points: Float[np.ndarray, "point dof"]) -> Float[np.ndarray, " point"]:
        padded = np.concatenate([points, np.repeat(points[-1:], -len(points) % BATCH, axis=0)])
        batches = jnp.asarray(padded.reshape(-1, BATCH, points.shape[1]), density.previous.log_weights.dtype)
        return np.asarray(_log_densities(batches, density, name), float).reshape(-1)[: len(points)]

    return evaluate


def _grid(evaluate: Evaluate, low: np.ndarray, high: np.ndarray, cells: int) -> tuple[list[np.ndarray], np.ndarray, float]:
    """Midpoints along each axis, the fraction of the mass in each cell, and the log of the mass."""
    axes = [a + (b - a) * (np.arange(cells) + 0.5) / cells for a, b in zip(low, high, strict=True)]
    points = np.stack([axis.reshape(-1) for axis in np.meshgrid(*axes, indexing="ij")], axis=1)
    logs = evaluate(points)
    logs = np.where(np.isnan(logs), -np.inf, logs)
    top = logs.max()
    if not np.isfinite(top):
        raise input_error("the posterior", "zero everywhere on the grid", "a frame that the model can explain", "start from another first pose")
    mass = np.exp(logs - top).reshape((cells,) * len(axes))
    return axes, mass / mass.sum(), float(top + np.log(mass.sum()) + np.sum(np.log((high - low) / cells)))


def _marginals(mass: np.ndarray) -> list[np.ndarray]:
    return [mass.sum(axis=tuple(dimension for dimension in range(mass.ndim) if dimension != axis)) for axis in range(mass.ndim)]


def _shrunk(evaluate: Evaluate, low: np.ndarray, high: np.ndarray) -> tuple[tuple[np.ndarray, np.ndarray], int]:
    axes, mass, _ = _grid(evaluate, low, high, COARSE)
    width, ends = (high - low) / COARSE, []
    for axis, marginal, step, least, most in zip(axes, _marginals(mass), width, low, high, strict=True):
        cells = np.flatnonzero(marginal > NEGLIGIBLE)
        # Keep one more cell on each side, because the mass between midpoints is unknown.
        ends.append((max(axis[cells[0]] - 1.5 * step, least), min(axis[cells[-1]] + 1.5 * step, most)))
    inner = np.array(ends).T
    return (inner[0], inner[1]), mass.size


def _moments(evaluate: Evaluate, low: np.ndarray, high: np.ndarray, cells: int) -> tuple[np.ndarray, np.ndarray, float, int]:
    axes, mass, log_evidence = _grid(evaluate, low, high, cells)
    marginals = _marginals(mass)
    mean = np.array([marginal @ axis for marginal, axis in zip(marginals, axes, strict=True)])
    sd = np.sqrt([marginal @ (axis - m) ** 2 for marginal, axis, m in zip(marginals, axes, mean, strict=True)])
    return mean, sd, log_evidence, mass.size


# Number of independent runs, and the largest accepted error of a mean, in Monte Carlo standard errors.
RUNS, LIMIT = 40, 4.0


class Comparison(NamedTuple):
    """Estimates by independent runs and by quadrature, by dof, radians or metres.

    Attributes:
        means: the mean of each run.
        variances: the variance of each run, about the quadrature's mean.
        off: distance of the runs' mean from the quadrature's, in Monte Carlo standard errors.
        variance_off: the same for the variances.
        exact: the quadrature.
    """

    means: Float[np.ndarray, "run dof"]
    variances: Float[np.ndarray, "run dof"]
    off: Float[np.ndarray, " dof"]
    variance_off: Float[np.ndarray, " dof"]
    exact: Quadrature


def compare(density: Density, kernel: Kernel, previous: Particles, key: Key, runs: int = RUNS, exact: Quadrature | None = None) -> Comparison:
    """Compare independent runs of a kernel on one frame with quadrature.

    Args:
        density: the frame's density. The quadrature sums over its previous particles; if all are equal, a few suffice.
        kernel: the kernel to check.
        previous: the previous particles for the kernel; they must represent the same distribution as the density's.
        key: for the runs.
        runs: number of runs.
        exact: the quadrature of the density, if it was computed already.
    """
    exact = integrate(density) if exact is None else exact
    centre = jnp.asarray(exact.mean, density.previous.log_weights.dtype)

    def moments(run_key: Key, density: Density) -> tuple[jax.Array, jax.Array]:
        next_particles, _ = kernel(run_key, previous, density.with_previous(previous))
        weights, pose = jax.nn.softmax(next_particles.log_weights), next_particles.states["pose"]
        return weights @ pose, weights @ (pose - centre) ** 2

    every = jax.jit(lambda keys, density: jax.lax.map(lambda run_key: moments(run_key, density), keys))
    means, variances = (np.asarray(estimates, float) for estimates in every(jax.random.split(key, runs), density))
    return Comparison(means, variances, _off(means, exact.mean), _off(variances, exact.sd**2), exact)


def _off(estimates: Float[np.ndarray, "run dof"], exact: Float[np.ndarray, " dof"]) -> Float[np.ndarray, " dof"]:
    """Distance of the runs' mean from the exact value, in standard errors of that mean."""
    return np.abs(estimates.mean(axis=0) - exact) / (estimates.std(axis=0, ddof=1) / np.sqrt(len(estimates)))


def check_reference(plan: Any, model: Model, names: Sequence[str], show: Callable[[str], None]) -> Verdict:
    """Check a model with likelihoods that are not generative.

    Args:
        plan: the plan of the check.
        model: the plan's model.
        names: names of these likelihoods.
        show: receives lines for the user.

    Raises:
        InputError: there is no image to use, or the body is placed by its parts or has too many dofs for a grid.
    """
    require(model.body, POSE, "a quadrature over joint angles", "a model of a body that is placed by angles")
    subject = f"the likelihood '{names[0]}'"
    problem = "it is not a distribution over images, so nothing can be simulated from it and there are no ranks"
    dofs = len(model.body.dof_names)
    if dofs > MOST_DOFS:
        expected = f"generative likelihoods (markers_gaussian, silhouette_bernoulli), or a body of at most {MOST_DOFS} dofs for a quadrature"
        raise input_error(
            subject, problem, f"{expected}, not {dofs}", "use coverage_50 and coverage_90 on a simulated recording: bayes-body simulate, then track"
        )
    if plan.session is None:
        expected = "an image on which the kernel's means are compared with a quadrature"
        raise input_error(subject, problem, expected, "give a recording with --session; its first frame is used")
    show(f"{names[0]}: {problem}; instead means and variances of {RUNS} runs on the session's first frame are compared with a grid quadrature.")
    session, term = load_session(Path(plan.session)), find("kernel", plan.kernel)
    options: Any = validate(term.options, plan.options, plan.kernel)
    density = model.density(jax.tree.map(jnp.asarray, model.observe(read_frame(session, 0))))
    check_own_factors(density, model.initial)
    found_out = compare(density, term.build(options=options), model.start(options.particles), jax.random.key(plan.seed))
    check_effective(where_of("kernel", plan.kernel), found_out.means)
    return _verdict(model.body.dof_names, found_out)


def _verdict(dofs: Sequence[str], comparison: Comparison) -> Verdict:
    exact, quantities = comparison.exact, {}
    deviations = np.sqrt(comparison.variances.mean(axis=0))
    for number, name in enumerate(dofs):
        true = {"quadrature": exact.mean[number], "quadrature_sd": exact.sd[number], "quadrature_error": exact.error[number]}
        runs = {
            "mean": comparison.means[:, number].mean(),
            "sd": deviations[number],
            "mcse_off": comparison.off[number],
            "sd_mcse_off": comparison.variance_off[number],
        }
        quantities[name] = {key: float(value) for key, value in (true | runs).items()}
    farthest = []
    for moment_name, off in (("mean", comparison.off), ("variance", comparison.variance_off)):
        worst = int(np.argmax(off))
        farthest.append(f"the {moment_name} of '{dofs[worst]}' is {off[worst]:.1f} Monte Carlo standard errors from that of a grid")
    sentence = f"quadrature ({exact.evaluations:,} evaluations): {', '.join(farthest)}, the largest of {len(dofs)} dofs; the limit is {LIMIT:.0f}."
    passed = bool(max(comparison.off.max(), comparison.variance_off.max()) < LIMIT)
    figures = {"reference": {"runs": len(comparison.means), "limit": LIMIT, "quantities": quantities}}
    return Verdict(passed, (sentence, "PASS." if passed else "FAIL."), figures)
