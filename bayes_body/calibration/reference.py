"""A model from which nothing can be simulated: a kernel's means over independent runs against a grid quadrature, on the first frame of a session."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bayes_body.calibration.quadrature import MOST_DOFS, Quadrature, integrate
from bayes_body.calibration.verdict import Verdict
from bayes_body.density import Density
from bayes_body.errors import wrong
from bayes_body.factor import Kernel, Particles
from bayes_body.model import Model
from bayes_body.observation.frames import read_frame
from bayes_body.registry import find
from bayes_body.session_file import load_session
from bayes_body.shapes import Key
from bayes_body.toml_file import validate

# Independent runs, and how many Monte Carlo standard errors (of their mean) a mean may be off.
RUNS, LIMIT = 40, 4.0


class Comparison(NamedTuple):
    """Means of independent runs, how far they are off in Monte Carlo standard errors, and the quadrature; by dof, radians or metres."""

    means: Float[np.ndarray, "run dof"]
    off: Float[np.ndarray, " dof"]
    exact: Quadrature


def compare(density: Density, kernel: Kernel, previous: Particles, key: Key, runs: int = RUNS) -> Comparison:
    """Independent runs of a kernel on one frame against quadrature.

    Args:
        density: of the frame; its particles before are all that the quadrature sums over, and few will do where all are one.
        kernel: whose means are looked at.
        previous: the particles before that the kernel starts from; they must mean the same as the density's.
        key: of the runs.
        runs: how many.
    """

    def one(own: Key, density: Density) -> jax.Array:
        after, _ = kernel(own, previous, density.given(previous))
        return jax.nn.softmax(after.log_weights) @ after.states["pose"]

    means = np.asarray(jax.jit(lambda keys, density: jax.lax.map(lambda own: one(own, density), keys))(jax.random.split(key, runs), density), float)
    exact = integrate(density)
    mcse = means.std(axis=0, ddof=1) / np.sqrt(runs)
    return Comparison(means, np.abs(means.mean(axis=0) - exact.mean) / mcse, exact)


def check_reference(plan: Any, model: Model, names: Sequence[str], show: Callable[[str], None]) -> Verdict:
    """What is checked of a model with likelihoods that are not generative.

    Args:
        plan: the check's.
        model: of the plan.
        names: of these likelihoods.
        show: takes lines for the user.

    Raises:
        InputError: there is no image to compare on, or the body has too many dofs for a grid.
    """
    subject = f"the likelihood '{names[0]}'"
    found = "it is no distribution over images, so that nothing can be simulated from it and no rank be taken"
    dofs = len(model.body.dof_names)
    if dofs > MOST_DOFS:
        expected = f"generative likelihoods (markers_gaussian, silhouette_bernoulli), or a body of at most {MOST_DOFS} dofs for a quadrature"
        raise wrong(
            subject, found, f"{expected}, not {dofs}", "look at coverage_50 and coverage_90 of a simulated recording: bayes-body simulate, then track"
        )
    if plan.session is None:
        expected = "an image on which the kernel's means are compared with a quadrature"
        raise wrong(subject, found, expected, "give a recording with --session; its first frame is taken")
    show(f"{names[0]}: {found}; instead the means of {RUNS} runs on the session's first frame are compared with a grid quadrature.")
    session, term = load_session(Path(plan.session)), find("kernel", plan.kernel)
    options: Any = validate(term.options, plan.options, plan.kernel)
    density = model.density(jax.tree.map(jnp.asarray, model.observe(read_frame(session, 0))))
    found_out = compare(density, term.build(options=options), model.start(options.particles), jax.random.key(plan.seed))
    return _verdict(model.body.dof_names, found_out)


def _verdict(dofs: Sequence[str], found: Comparison) -> Verdict:
    worst = int(np.argmax(found.off))
    passed = bool((found.off < LIMIT).all())
    exact = found.exact
    quantities = {
        name: {"mean": float(mean), "quadrature": float(true), "quadrature_sd": float(sd), "quadrature_error": float(error), "mcse_off": float(off)}
        for name, mean, true, sd, error, off in zip(dofs, found.means.mean(axis=0), exact.mean, exact.sd, exact.error, found.off, strict=True)
    }
    said = (
        f"quadrature: the mean of '{dofs[worst]}' is {found.off[worst]:.1f} Monte Carlo standard errors from that of a grid "
        f"({exact.evaluations:,} evaluations), the farthest of {len(dofs)}; {LIMIT:.0f} are allowed."
    )
    figures = {"reference": {"runs": len(found.means), "limit": LIMIT, "quantities": quantities}}
    return Verdict(passed, (said, "PASS." if passed else "FAIL."), figures)
