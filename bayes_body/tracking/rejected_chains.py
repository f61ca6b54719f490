"""Detection of Markov chains that do not move. If no trajectory of a frame is accepted, all later frames would only repeat the chains' starts."""

import numpy as np

from bayes_body.base.errors import input_error
from bayes_body.density.kernel import FilterInfo

# Chains with a lower mean acceptance do not move; the suggested step is smaller by this factor.
LEAST_ACCEPTANCE, REDUCTION = 1e-3, 10.0
# A step factor at which trajectories are stable on most posteriors.
USUAL_STEP = 0.2


def raise_if_all_rejected(info: FilterInfo, frame: int) -> None:
    """Raise an error if no chain of a frame moves.

    Args:
        info: the diagnostics of one run and frame.
        frame: the frame's number.

    Raises:
        InputError: no chain moves, and the frame is not lost.
    """
    if not info.markov or bool(np.any(info.lost)):
        return
    acceptance, divergences, step = (np.asarray(info.markov[name], float) for name in ("acceptance", "divergences", "step"))
    if not acceptance.mean() < LEAST_ACCEPTANCE:
        return
    size = float(np.median(step))
    suggested = min(size / REDUCTION, USUAL_STEP)
    problem = f"at a step factor of {size:.3g} the acceptance is {acceptance.mean():.1g} ({divergences.sum():.0f} trajectories diverged)"
    raise input_error(
        f"frame {frame}: no chain moves", problem, "a smaller step", f"try step={suggested:.2g}, or target_acceptance=0.8, which tunes it"
    )
