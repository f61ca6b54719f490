"""Errors of two samplers' posterior means against computation, on one frame after one mixture (Poon & Fleet 2002, Fig. 8)."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from equal_computation import Equal, Runs, at_equal_computation
from jaxtyping import Float
from true_mean import Truth

from bayes_body.base.files.atomic import replacing
from bayes_body.base.shapes import Key
from bayes_body.density.density import Density
from bayes_body.view.colours import GREY, INK, run_line, run_mark

# The variables of the paper's four panels.
SHOWN = ("r_hip_x", "r_hip_y", "r_hip_z", "r_knee")


class Curve(NamedTuple):
    """Squared errors of posterior means at several amounts of computation, in units of the posterior's variance, with their standard errors.

    Attributes:
        evaluations: computation of a run, in evaluations of the density.
        hmc: mean over the runs, and its standard error.
        sir: the same of the particle filter.
    """

    evaluations: Float[np.ndarray, " size"]
    hmc: Float[np.ndarray, "2 size dof"]
    sir: Float[np.ndarray, "2 size dof"]


def equal_computations(key: Key, density: Density, options: Mapping[str, Any], draws: Sequence[int], runs: int) -> list[Equal]:
    """Return runs of both samplers at equal computation, for each number of draws of hmc."""
    return [at_equal_computation(jax.random.fold_in(key, number), density, options, count, runs) for number, count in enumerate(draws)]


def curve_of(equals: Sequence[Equal], truth: Truth) -> Curve:
    """Return the errors at each amount of computation."""

    def moments(runs: Runs) -> Float[np.ndarray, "2 dof"]:
        squared, noise = truth.squared_errors(runs.means) / truth.sd**2, truth.noise / truth.sd**2
        # A mean below the noise of the truth is not known better than that.
        return np.stack([np.maximum(squared.mean(axis=0), noise), squared.std(axis=0, ddof=1) / np.sqrt(len(squared))])

    hmc, sir = (np.stack([moments(runs) for runs in column], axis=1) for column in zip(*((e.hmc, e.sir["evaluations"]) for e in equals), strict=True))
    return Curve(np.array([equal.particles["evaluations"] for equal in equals], float), hmc, sir)


def draw_curve(path: Path, names: Sequence[str], curve: Curve) -> None:
    """Write a .png with a panel for each angle of the right hip and the right knee. Whiskers are one standard error, as in the paper.

    Raises:
        InputError: the file cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 3.2), layout="constrained")
    for axes, name in zip(figure.subplots(1, len(SHOWN), sharey=True), SHOWN, strict=True):
        dof = list(names).index(name)
        for number, (label, errors, colour) in enumerate((("hybrid Monte Carlo", curve.hmc, INK), ("particle filter", curve.sir, GREY))):
            mean, error = errors[:, :, dof]
            style = {"fmt": run_mark(number), "linestyle": run_line(number), "capsize": 3, "color": colour, "label": label}
            axes.errorbar(curve.evaluations, mean, yerr=[np.minimum(error, 0.9 * mean), error], **style)
        axes.set(xscale="log", yscale="log", title=name, xlabel="evaluations of a run")
        axes.minorticks_off()
        axes.set_xticks(curve.evaluations, [f"{count / 1000:.3g}k" for count in curve.evaluations])
    figure.axes[0].set_ylabel("error² of the mean /\nvariance of the posterior")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=2, fontsize="small")
    with replacing(path) as partial:
        figure.savefig(partial, format="png", dpi=100)
