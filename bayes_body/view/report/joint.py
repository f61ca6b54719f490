"""The section on paths that are drawn from one Gaussian of all frames: how well it fits about each frame, and which dofs lie near a limit."""

import numpy as np

from bayes_body.view.report.figures import draw_limit, encoded
from bayes_body.view.report.inspection import Inspection, spoken
from bayes_body.view.report.markup import Markup, Picture, figures, section, table, tag
from bayes_body.view.report.panels import run_panel

TITLE = "One Gaussian of all frames"
ABOUT = (
    "The paths are draws of one Gaussian, found by Newton steps on all frames together. In windows of three frames it is compared with the exact "
    "density: the draws get importance weights, and Pareto k is the shape of their tail. Up to the limit (the purple line) the Gaussian fits. "
    "It does not see that a dof stays at its limit for many frames: there the Gaussian is too far from the limit."
)


def joint_section(inspection: Inspection) -> Markup:
    """Return the section: the search, Pareto k over the frames, and the dofs near their limits."""
    fit = inspection.diagnosis.joint
    if fit is None:
        return section("joint", TITLE, tag("p", "The paths come another way."))
    steps = ", ".join(f"{count}{'' if done else ' (not converged)'}" for count, done in zip(fit.steps, fit.converged, strict=True))
    parts = [tag("p", ABOUT), tag("p", f"Newton steps of each run: {steps}.")]
    share = fit.share_of_good_windows(inspection.limits.pareto_k)
    if np.isnan(share):
        parts.append(tag("p", "There are too few paths for Pareto k."))
    else:
        parts += [tag("p", f"{share:.0%} of the windows are within the limit."), figures([_windows(inspection, fit.pareto_k)])]
    shares = sorted(((dof, part) for dof, part in fit.near_limit_shares.items() if part > 0), key=lambda item: -item[1])
    if shares:
        rows = [(spoken(dof), f"{part:.0%}") for dof, part in shares]
        parts += [tag("h3", "Within three standard deviations of a limit, share of the frames"), table((), rows)]
    return section("joint", TITLE, *parts)


def _windows(inspection: Inspection, shapes: np.ndarray) -> Picture:
    figure, axes = run_panel(inspection, "Tail of the weights of windows", "Pareto k", np.where(np.isfinite(shapes), shapes, np.nan))
    draw_limit(axes, inspection.limits.pareto_k)
    worst = np.max(shapes[~np.isnan(shapes)])
    return encoded(figure, f"Pareto k of windows of three frames over the frames, at most {worst:.2f}; the limit is {inspection.limits.pareto_k}.")
