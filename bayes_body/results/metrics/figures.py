"""The figures of `summary.json` about the error: millimetres, and fractions between 0 and 1.

They follow HumanEva (Sigal, Balan & Black 2010). The error of a frame is the mean over its markers. The error of a recording is the mean over its
frames, and is given with the standard deviation over the frames. The optimistic error is that of the best particle of each frame (Balan, Sigal &
Black 2005), which a tracker cannot identify.
"""

from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from bayes_body.results.metrics.accuracy import LEVELS
from bayes_body.results.metrics.truth import AgainstTruth, mean_known

NAMES = (
    *("error_mm_mean", "error_mm_std", "error_mm_optimistic", "error_mm_relative", "error_mm_by_marker", "coverage_50", "coverage_90"),
    *("error_mm_mean_fitted_offset", "coverage_90_fitted_offset"),
)
# The 90 % intervals are too narrow if their coverage is below the first, too wide if it is above the second.
ACCEPTED = (0.80, 0.98)


def accuracy_figures(comparison: AgainstTruth | None, mode_seeker: bool) -> dict[str, Any]:
    """Return the figures NAMES; None for a figure that does not exist, and for all of them without a truth.

    Args:
        comparison: the run compared with the truth.
        mode_seeker: whether the kernel is a mode seeker. Its particles are not a sample of the posterior, so it has no intervals and no coverage.
    """
    if comparison is None:
        return dict.fromkeys(NAMES)
    plain, fitted = comparison.plain, comparison.fitted
    return {
        "error_mm_mean": _mm(plain.frame_error),
        "error_mm_std": _number_or_none(1000 * sd_over_frames(plain.frame_error)),
        "error_mm_optimistic": _mm(plain.optimistic),
        "error_mm_relative": _mm(plain.relative),
        "error_mm_by_marker": {name: _mm(plain.error[..., place]) for place, name in enumerate(plain.names)},
        "coverage_50": None if mode_seeker else coverage_at(plain.coverage, 0.5),
        "coverage_90": None if mode_seeker else coverage_at(plain.coverage, 0.9),
        "error_mm_mean_fitted_offset": None if fitted is None else _mm(fitted.frame_error),
        "coverage_90_fitted_offset": None if fitted is None or mode_seeker else coverage_at(fitted.coverage, 0.9),
    }


def sd_over_frames(frame_error: Float[np.ndarray, "frame run"]) -> float:
    """Return the standard deviation of a run's error over the frames, mean over the runs, metres; NaN if fewer than two frames have a known truth."""
    finite_errors = frame_error[np.isfinite(frame_error).all(axis=1)]
    return float(finite_errors.std(axis=0, ddof=1).mean()) if len(finite_errors) > 1 else float("nan")


def coverage_at(coverage: Float[np.ndarray, " level"], level: float) -> float | None:
    """Return the coverage of one of LEVELS; None if no truth is known."""
    return _number_or_none(coverage[LEVELS.index(level)])


def width(coverage_90: float) -> str:
    """Say whether 90 % intervals with this coverage are too narrow, too wide or about right."""
    low, high = ACCEPTED
    return "too narrow" if coverage_90 < low else "too wide" if coverage_90 > high else "about right"


def _mm(metres: Float[np.ndarray, "..."]) -> float | None:
    return _number_or_none(1000 * mean_known(metres.ravel(), 0))


def _number_or_none(value: float | np.floating | NDArray[np.floating]) -> float | None:
    return float(value) if np.isfinite(value) else None
