"""For a model that cannot be simulated: compare a kernel's posterior over independent runs with grid quadrature, on a session's first frame."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import input_error
from bayes_body.base.registry import find
from bayes_body.base.shapes import Key
from bayes_body.base.toml.read import validate
from bayes_body.density.density import Density
from bayes_body.density.factor import Particles
from bayes_body.density.kernel import Kernel
from bayes_body.model.body.placement import POSE
from bayes_body.model.body.world import require
from bayes_body.model.build import Model
from bayes_body.model.plugins.load import check_own_factors, where_of
from bayes_body.recording.observation.frames import read_frame
from bayes_body.recording.session.read import load_session
from bayes_body.workshop.calibration.probe import check_effective
from bayes_body.workshop.calibration.quadrature import MOST_DOFS, Quadrature, integrate
from bayes_body.workshop.calibration.verdict import Verdict

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
        after, _ = kernel(run_key, previous, density.with_previous(previous))
        weights, pose = jax.nn.softmax(after.log_weights), after.states["pose"]
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
    for what, off in (("mean", comparison.off), ("variance", comparison.variance_off)):
        worst = int(np.argmax(off))
        farthest.append(f"the {what} of '{dofs[worst]}' is {off[worst]:.1f} Monte Carlo standard errors from that of a grid")
    sentence = f"quadrature ({exact.evaluations:,} evaluations): {', '.join(farthest)}, the largest of {len(dofs)} dofs; the limit is {LIMIT:.0f}."
    passed = bool(max(comparison.off.max(), comparison.variance_off.max()) < LIMIT)
    figures = {"reference": {"runs": len(comparison.means), "limit": LIMIT, "quantities": quantities}}
    return Verdict(passed, (sentence, "PASS." if passed else "FAIL."), figures)
