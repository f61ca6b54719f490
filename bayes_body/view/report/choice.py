"""Choose the frames and dofs that are shown in detail, and draw samples of equal weight there."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.results.posterior.blocks import coordinate_blocks, weights_of_runs
from bayes_body.results.posterior.resampling import RESAMPLING_SEED
from bayes_body.view.report.curves import dof_scale
from bayes_body.view.report.inspection import Inspection

FEWEST_DRAWS, MOST_DRAWS, DOFS = 20, 200, 3


class Sample(NamedTuple):
    """Draws of equal weight at one frame.

    Attributes:
        frame: index of the frame.
        poses: the drawn poses, degrees and metres.
    """

    frame: int
    poses: Float[np.ndarray, "run draw dof"]


def worst_frame(it: Inspection) -> int:
    """Return the frame with the largest R-hat; if there is no R-hat, the frame with the fewest effective particles."""
    if it.agreement_known:
        return int(np.nan_to_num(it.diagnosis.rhat, nan=-np.inf).max(axis=1).argmax())
    return int(it.diagnosis.ess.min(axis=0).argmin())


def chosen_frames(it: Inspection) -> list[int]:
    """Return the first, the worst and the last frame, without repetition."""
    return sorted({0, worst_frame(it), len(it.diagnosis.lost[0]) - 1})


def chosen_dofs(it: Inspection) -> list[int]:
    """Return the dofs with the largest R-hat in some frame.

    If there is no R-hat, return those with the largest spread in the worst frame, in degrees or metres: angles come before positions.
    """
    if it.agreement_known:
        figures_of = np.nan_to_num(it.diagnosis.rhat, nan=-np.inf).max(axis=0)
    else:
        figures_of = equal_weight_sample(it, worst_frame(it)).poses.std(axis=(0, 1))
    ordered = np.argsort(-figures_of, kind="stable")[:DOFS].tolist()
    # A dof that never moves has no R-hat and no spread: there is nothing to plot.
    return [dof for dof in ordered if figures_of[dof] > 0]


def equal_weight_sample(it: Inspection, frame: int) -> Sample:
    """Return systematic draws in random order. Their number is the smallest effective sample size of the runs, within FEWEST_DRAWS and MOST_DRAWS."""
    ess = float(np.nanmin(it.diagnosis.ess[:, frame]))
    count = round(np.clip(ess, FEWEST_DRAWS, MOST_DRAWS))
    (block,) = coordinate_blocks(it.run.tree, range(frame, frame + 1), spaces=it.run.spaces)
    rng = np.random.default_rng([RESAMPLING_SEED, frame])
    out = []
    for weights, poses in zip(weights_of_runs(block.log_weights)[..., 0], block.poses[:, :, 0], strict=True):
        levels = (np.arange(count) + rng.random()) / count
        places = np.minimum(np.searchsorted(np.cumsum(weights), levels), len(weights) - 1)
        out.append(poses[rng.permutation(places)])
    return Sample(frame, np.stack(out) * dof_scale(it.units))
