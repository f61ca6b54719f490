"""Markov chains that stand still: where no trajectory of a frame is accepted, all frames behind it would be those chains' starts."""

import numpy as np

from bayes_body.density.factor import FilterInfo
from bayes_body.errors import input_error

# Mean acceptance of a frame's chains below which they stand still, and how much smaller a step is suggested.
LEAST, SMALLER = 1e-3, 10.0
# A step factor at which trajectories are stable on most posteriors.
USUAL = 0.2


def raise_if_all_rejected(info: FilterInfo, frame: int) -> None:
    """Stop where all chains of a frame stand still.

    Args:
        info: of one run and frame.
        frame: its number.

    Raises:
        InputError: they do, on a frame that is not lost.
    """
    if not info.markov or bool(np.any(info.lost)):
        return
    acceptance, divergences, step = (np.asarray(info.markov[name], float) for name in ("acceptance", "divergences", "step"))
    if not acceptance.mean() < LEAST:
        return
    size = float(np.median(step))
    suggested = min(size / SMALLER, USUAL)
    found = f"at a step factor of {size:.3g} the acceptance is {acceptance.mean():.1g} ({divergences.sum():.0f} trajectories diverged)"
    raise input_error(
        f"frame {frame}: the chains stand still", found, "a smaller step", f"try step={suggested:.2g}, or target_acceptance=0.8, which tunes it"
    )
