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
from bayes_body.results.metrics.angles import AngleAccuracy
from bayes_body.results.metrics.calibration import calibration_errors, error_by_certainty, tarp
from bayes_body.results.metrics.truth import Accuracy, AgainstTruth, mean_known

SCORES = ("coverage_90_by_marker", "ece_radial", "ece_radial_by_marker", "tarp", "crps_mm", "error_mm_by_certainty")
ANGLES = ("angle_rms_deg", "angle_coverage_90", "angle_rms_deg_by_angle", "angle_coverage_90_by_angle")
NAMES = (
    *("error_mm_mean", "error_mm_std", "error_mm_optimistic", "error_mm_relative", "error_mm_by_marker", "coverage_50", "coverage_90"),
    *("error_mm_mean_fitted_offset", "coverage_90_fitted_offset"),
    *SCORES,
    *ANGLES,
)
# Decimals of the figures by marker and by angle, and of fractions.
DIGITS = 4
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
        **(dict.fromkeys(SCORES) if mode_seeker else _scores(plain)),
        **_angles(comparison.angles, mode_seeker),
    }


def _scores(plain: Accuracy) -> dict[str, Any]:
    """Return the figures SCORES. Those by marker are in the order from the worst marker to the best; unknown markers are left out."""
    scores = plain.scores
    if scores is None or not plain.known.any():
        return dict.fromkeys(SCORES)
    errors = calibration_errors(scores.level)
    joint = tarp(scores.rank, plain.frame_error)
    by_certainty = 1000 * error_by_certainty(plain.error, scores.spread)
    return {
        "coverage_90_by_marker": _by_name(plain.names, plain.coverage_by_marker[LEVELS.index(0.9)], lowest_first=True),
        "ece_radial": round(float(np.nanmedian(errors)), DIGITS),
        "ece_radial_by_marker": _by_name(plain.names, errors),
        "tarp": None if joint is None else {key: round(value, DIGITS) for key, value in joint._asdict().items()} | {"verdict": joint.verdict},
        "crps_mm": _mm(scores.crps),
        "error_mm_by_certainty": [round(float(error), 2) for error in by_certainty],
    }


def _angles(angles: AngleAccuracy | None, mode_seeker: bool) -> dict[str, Any]:
    """Return the figures ANGLES. Those by angle are in the order from the worst angle to the best."""
    if angles is None or not angles.names:
        return dict.fromkeys(ANGLES)
    coverage = angles.coverage[LEVELS.index(0.9)]
    return {
        "angle_rms_deg": float(np.sqrt((angles.rms_deg**2).mean())),
        "angle_coverage_90": None if mode_seeker else float(coverage.mean()),
        "angle_rms_deg_by_angle": _by_name(angles.names, angles.rms_deg),
        "angle_coverage_90_by_angle": None if mode_seeker else _by_name(angles.names, coverage, lowest_first=True),
    }


def _by_name(names: tuple[str, ...], values: Float[np.ndarray, " name"], lowest_first: bool = False) -> dict[str, float]:
    """Return the known values by name, the largest first, or the lowest."""
    order = np.argsort(values if lowest_first else -values, kind="stable")
    return {names[place]: round(float(values[place]), DIGITS) for place in order if np.isfinite(values[place])}


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
