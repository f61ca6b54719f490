r"""Calibration of a whole run against the truth, from the scores of its frames.

- **Expected calibration error** of a marker: $\mathrm{mean}_L\, |\hat p(L) - L|$ over 21 levels from 0 to 1, where $\hat p(L)$ is the fraction of
  frames and runs in which the truth is within the radial quantile L (`scores`). The median over markers can hide a bad marker.
- **TARP**: the coverage of level L is the fraction of ranks below L. Reported is the largest deviation from L. Its standard deviation,
  $\sqrt{L (1 - L) / n}$, is that of n independent frames. Frames depend on each other, so only every k-th is used, where k is the integrated
  autocorrelation time of the error, $1 + 2 \sum_l \rho_l$ up to the first lag without a positive autocorrelation.
- **Error by certainty**: frames are sorted by their markers' mean spread, and the error is averaged over the most certain 10, 20, ..., 100 % of them.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from bayes_body.results.posterior.mixing import autocorrelation
from bayes_body.results.posterior.moments import ROUNDING

# Nominal levels of the calibration curve.
NOMINAL = np.linspace(0, 1, 21)
# Fractions of the frames, the most certain ones, for which the error is given.
CERTAIN = np.linspace(0.1, 1, 10)
# With fewer independent frames, TARP says nothing; a deviation above this, over sqrt(n), has a probability of 5 % for uniform ranks
# (Kolmogorov-Smirnov).
FEWEST_RANKS, UNLIKELY = 5, 1.36


class Scores(NamedTuple):
    """The scores of all frames and runs (`scores.FrameScores`), metres; NaN where the truth is unknown."""

    level: Float[np.ndarray, "frame run marker"]
    crps: Float[np.ndarray, "frame run marker"]
    spread: Float[np.ndarray, "frame run marker"]
    rank: Float[np.ndarray, "frame run"]


class Tarp(NamedTuple):
    """The coverage of the joint distribution.

    Attributes:
        deviation: coverage minus level, at the level at which it is largest in size. Below 0 the posterior is too narrow or beside the truth.
        level: that level.
        sd: standard deviation of a calibrated posterior's deviation at that level.
        frames: number of frames that were used.
    """

    deviation: float
    level: float
    sd: float
    frames: int

    @property
    def verdict(self) -> str:
        """Whether the posterior is too narrow, too wide or about right."""
        if abs(self.deviation) * np.sqrt(self.frames) < UNLIKELY:
            return "about right"
        return "too narrow" if self.deviation < 0 else "too wide"


def calibration_curves(level: Float[np.ndarray, "frame run marker"]) -> Float[np.ndarray, "nominal marker"]:
    """Return the fraction of known truths within the radial quantile of each of NOMINAL; NaN for a marker that is never known."""
    return np.stack([_share_below(level, nominal) for nominal in NOMINAL])


def calibration_errors(level: Float[np.ndarray, "frame run marker"]) -> Float[np.ndarray, " marker"]:
    """Return each marker's expected calibration error, between 0 and 1; NaN for a marker that is never known."""
    return np.abs(calibration_curves(level) - NOMINAL[:, None]).mean(axis=0)


def tarp(rank: Float[np.ndarray, "frame run"], error: Float[np.ndarray, "frame run"]) -> Tarp | None:
    """Return the coverage of the joint distribution; None with fewer than FEWEST_RANKS independent frames.

    Args:
        rank: TARP ranks; NaN where nothing of the truth is known.
        error: error of the frames in any unit; it shows how many frames apart are independent.
    """
    is_known = np.isfinite(rank).all(axis=1)
    ranks = rank[is_known][:: correlated_frames(error[is_known])]
    if len(ranks) < FEWEST_RANKS:
        return None
    levels = NOMINAL[1:-1]
    deviations = np.array([_share_below(ranks.ravel()[:, None, None], level).item() for level in levels]) - levels
    largest = int(np.abs(deviations).argmax())
    level = float(levels[largest])
    return Tarp(float(deviations[largest]), level, float(np.sqrt(level * (1 - level) / len(ranks))), len(ranks))


def correlated_frames(error: Float[np.ndarray, "frame run"]) -> int:
    """Return the integrated autocorrelation time of the error, in whole frames; 1 for an error that never changes or of fewer than two frames."""
    if len(error) < 2:
        return 1
    # Centred by run: a run that is worse than another throughout is no correlation over time.
    correlations = autocorrelation((error - error.mean(axis=0)).T)[1:]
    is_positive = np.logical_and.accumulate(correlations > 0)
    return int(np.ceil(1 + 2 * correlations[is_positive].sum()))


def error_by_certainty(error: Float[np.ndarray, "frame run marker"], spread: Float[np.ndarray, "frame run marker"]) -> Float[np.ndarray, " share"]:
    """Return the mean error of the most certain frames, for each fraction in CERTAIN, mean over the runs, in its unit; NaN without a truth."""
    is_known = np.isfinite(error).any(axis=(1, 2))
    if not is_known.any():
        return np.full(len(CERTAIN), np.nan)
    certain_first = np.argsort(np.nanmean(spread[is_known], axis=-1), axis=0, kind="stable")
    errors = np.take_along_axis(np.nanmean(error[is_known], axis=-1), certain_first, axis=0).mean(axis=1)
    counts = np.ceil(CERTAIN * len(errors) - ROUNDING).astype(int)
    return np.cumsum(errors)[counts - 1] / counts


def _share_below(values: NDArray[np.floating], level: float) -> Float[np.ndarray, " marker"]:
    """Return the fraction of known values below the level, over frames and runs; NaN where none is known."""
    count = np.isfinite(values).sum(axis=(0, 1))
    return np.divide((values < level - ROUNDING).sum(axis=(0, 1)), count, out=np.full(count.shape, np.nan), where=count > 0)
