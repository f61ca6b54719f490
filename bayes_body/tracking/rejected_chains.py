"""Markov chains that stand still: if no trajectory of a frame is accepted, all later frames would only repeat the starts of those chains."""

import numpy as np

from bayes_body.density.kernel import FilterInfo
from bayes_body.errors import input_error

# Chains with a lower mean acceptance stand still; the suggested step is smaller by this factor.
LEAST_ACCEPTANCE, REDUCTION = 1e-3, 10.0
# A step factor at which trajectories are stable on most posteriors.
USUAL_STEP = 0.2


def raise_if_all_rejected(info: FilterInfo, frame: int) -> None:
    """Stop if all chains of a frame stand still.

    Args:
        info: of one run and frame.
        frame: its number.

    Raises:
        InputError: they stand still, on a frame that is not lost.
    """
    if not info.markov or bool(np.any(info.lost)):
        return
    acceptance, divergences, step = (np.asarray(info.markov[name], float) for name in ("acceptance", "divergences", "step"))
    if not acceptance.mean() < LEAST_ACCEPTANCE:
        return
    size = float(np.median(step))
    suggested = min(size / REDUCTION, USUAL_STEP)
    found = f"at a step factor of {size:.3g} the acceptance is {acceptance.mean():.1g} ({divergences.sum():.0f} trajectories diverged)"
    raise input_error(
        f"frame {frame}: the chains stand still", found, "a smaller step", f"try step={suggested:.2g}, or target_acceptance=0.8, which tunes it"
    )
