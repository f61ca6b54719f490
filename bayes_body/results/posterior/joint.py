"""What the search for one Gaussian of all frames says of a run whose paths are drawn from it: its steps, and where the Gaussian cannot be trusted."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

if TYPE_CHECKING:
    import xarray as xr

# Prefix of the names of these figures in the tree's group `filter`.
JOINT = "joint_"


@dataclass(frozen=True)
class JointFit:
    """The figures of a run whose paths are drawn from one Gaussian of all frames.

    Attributes:
        steps: number of steps of the search.
        converged: whether the search ended before its largest number of steps.
        pareto_k: tail shape of the weights of the window of three frames about a frame; -∞ if they are nearly equal, NaN with too few draws.
        near_limit: whether the mean of a dof is within three standard deviations of its limit.
        dofs: names of these dofs; none if the dynamics do not sample the variable that places the body.
    """

    steps: Int[np.ndarray, " run"]
    converged: Bool[np.ndarray, " run"]
    pareto_k: Float[np.ndarray, "run frame"]
    near_limit: Bool[np.ndarray, "run frame dof"]
    dofs: tuple[str, ...]

    @property
    def near_limit_shares(self) -> dict[str, float]:
        """For each dof, the share of frames, over all runs, in which it is near its limit."""
        return dict(zip(self.dofs, self.near_limit.mean(axis=(0, 1)).tolist(), strict=True))

    def share_of_good_windows(self, limit: float) -> float:
        """Return the share of frames, over all runs, whose k is not above the limit; NaN if no k is known."""
        has_k = ~np.isnan(self.pareto_k)
        return float((self.pareto_k[has_k] <= limit).mean()) if has_k.any() else float("nan")


def joint_of(tree: "xr.DataTree") -> JointFit | None:
    """Return the figures of a tree; None for draws that come another way."""
    group = tree["filter"]
    if f"{JOINT}steps" not in group:
        return None
    steps, converged, shapes = (np.asarray(group[JOINT + name]) for name in ("steps", "converged", "pareto_k"))
    fit = JointFit(steps[:, 0].astype(int), converged[:, 0].astype(bool), shapes.astype(float), np.zeros((*shapes.shape, 0), bool), ())
    if f"{JOINT}near_limit" not in group:
        return fit
    flags = group[f"{JOINT}near_limit"]
    names = tuple(np.asarray(flags[str(flags.dims[-1])]).astype(str).tolist())
    return JointFit(fit.steps, fit.converged, fit.pareto_k, np.asarray(flags).astype(bool), names)


def worst_of_joint(fit: JointFit, k_limit: float) -> dict[str, float]:
    """Return the figures for `summary.json`."""
    return {
        "joint_steps_max": float(fit.steps.max()),
        "joint_converged_share": float(fit.converged.mean()),
        "joint_pareto_k_share": fit.share_of_good_windows(k_limit),
        "joint_near_limit_max": max(fit.near_limit_shares.values(), default=0.0),
    }
