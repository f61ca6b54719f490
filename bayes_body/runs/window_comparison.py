"""Models compared on some frames by bridge sampling of NUTS draws, where the filters' runs disagree (kernels/paths/window_evidence.py).

The filters' particles before the window give the prior of its first frame, as one Gaussian. Inside the window nothing is approximated. So what the
runs disagree about inside it does not matter, and what they disagree about before it does.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from bayes_body.base.errors import input_error
from bayes_body.base.progress import Watch, unwatched
from bayes_body.results.evidence.candidates import Candidate, Recording, check_constraints
from bayes_body.results.evidence.comparison import LEAST
from bayes_body.results.evidence.estimate import Estimate, estimate
from bayes_body.results.posterior.window import AGREE
from bayes_body.runs.window import window_of_run

# Half the width of a 95 % interval of the difference, in errors of the bridge, whose draws are many.
WIDTH = 1.96
# Draws of each of the chains of a folder's window, as inference/window.py has them.
DRAWS = {"warm_up": 500, "draws": 1000}


class WindowRow(NamedTuple):
    """A model on the frames of a window.

    Attributes:
        name: of the model.
        filters: what the filters say of the same frames; its last entry is that of all of them.
        value: log-evidence by bridge sampling, nats: the logarithm of the mean over the folders of its runs.
        error: its Monte Carlo error, nats.
        r_hat: largest of the chains.
        divergent: number of trajectories that diverged.
    """

    name: str
    filters: Estimate
    value: float
    error: float
    r_hat: float
    divergent: int


class WindowComparison(NamedTuple):
    """The models on the frames of a window, numbers in the recording, the better ones first."""

    first: int
    last: int
    rows: tuple[WindowRow, ...]

    @property
    def preferred(self) -> str | None:
        """Name of the model that these frames prefer; None if the chains of the best two disagree, or if the models hardly differ."""
        (best, second), lead = self.rows[:2], self.lead
        sure = best.r_hat <= AGREE and second.r_hat <= AGREE and lead[0] - WIDTH * lead[1] > 0
        return best.name if sure and lead[0] >= LEAST else None

    @property
    def lead(self) -> tuple[float, float]:
        """By how many nats the best model is ahead of the second one, and the Monte Carlo error."""
        best, second = self.rows[:2]
        return best.value - second.value, float(np.hypot(best.error, second.error))


def compare_on_window(
    candidates: Sequence[Candidate], recording: Recording, first: int, last: int, seed: int = 0, watch: Watch = unwatched
) -> WindowComparison:
    """Return the models on some frames.

    Args:
        candidates: the models with their runs.
        recording: what was tracked.
        first: number of the window's first frame, which is not the run's first.
        last: number of its last one.
        seed: of the smoother, the chains and the bridge.
        watch: wraps the runs to show progress.

    Raises:
        InputError: there are no such frames, the evidence of a window does not mean the same in all runs, or one cannot be sampled.
    """
    end = recording.first_frame + candidates[0].log_evidence.shape[1] - 1
    if not recording.first_frame < first <= last <= end:
        problem, expected = f"{first}-{last}", f"ascending frames from {recording.first_frame + 1} to {end}"
        raise input_error("--window", problem, expected, "give others; the first frame has no frame before it")
    work = [(candidate, folder) for candidate in candidates for folder in candidate.folders]
    check_constraints([folder for _, folder in work])
    sampled: dict[str, list[tuple[float, float, float, int]]] = {}
    for number in watch(range(len(work))):
        candidate, folder = work[number]
        window = window_of_run(folder, last - first + 1, first, seed, "gaussian", **DRAWS)
        (value, error), draws = window.evidence, window.draws
        sampled.setdefault(candidate.name, []).append((value, error, float(np.max(draws.r_hat)), int(np.sum(draws.divergent))))
    place = slice(first - recording.first_frame, last - recording.first_frame + 1)
    rows = [_row(candidate.name, estimate(candidate.log_evidence[:, place]), sampled[candidate.name]) for candidate in candidates]
    return WindowComparison(first, last, tuple(sorted(rows, key=lambda row: -row.value)))


def _row(name: str, filters: Estimate, sampled: Sequence[tuple[float, float, float, int]]) -> WindowRow:
    values, errors, r_hats, divergent = (np.array(column, float) for column in zip(*sampled, strict=True))
    if not np.isfinite(values).all():
        return WindowRow(name, filters, -np.inf, np.inf, float(r_hats.max()), int(divergent.sum()))
    share = np.exp(values - np.logaddexp.reduce(values))
    # What is left of the folders' disagreement, which the errors of their bridges do not contain, is the larger of both.
    between = values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else 0.0
    error = max(float(np.sqrt((share**2 * errors**2).sum())), float(between))
    return WindowRow(name, filters, float(np.logaddexp.reduce(values) - np.log(len(values))), error, float(r_hats.max()), int(divergent.sum()))


def window_verdict(comparison: WindowComparison) -> str:
    """Return what the images of the window say about the best two models, in one sentence."""
    (best, second), (value, error) = comparison.rows[:2], comparison.lead
    frames = f"frames {comparison.first}-{comparison.last}" if comparison.first < comparison.last else f"frame {comparison.first}"
    place = f"In {frames}, by bridge sampling,"
    disagreeing = [row for row in (best, second) if row.r_hat > AGREE]
    if not np.isfinite(value):
        return f"{place} there is no verdict: no normal distribution reaches the draws of `{second.name}`."
    if disagreeing:
        chains = " and ".join(f"`{row.name}` (R-hat {row.r_hat:.2f}, limit {AGREE})" for row in disagreeing)
        return f"{place} there is no verdict: the chains of {chains} do not agree."
    if comparison.preferred:
        return f"{place} `{best.name}` is preferred to `{second.name}` by {value:.1f} ± {error:.2f} nats, given the images before."
    return f"{place} the images do not tell `{best.name}` from `{second.name}`: they differ by {value:.1f} ± {error:.2f} nats."


def window_figures(comparison: WindowComparison) -> dict[str, Any]:
    """Return everything as plain numbers for a file of JSON."""
    rows = [
        {
            "name": row.name,
            "log_evidence": row.value,
            "log_evidence_error": row.error,
            "rhat_max": row.r_hat,
            "divergent": row.divergent,
            "filters": float(row.filters.value[-1]),
            "filters_sd": None if row.filters.runs < 2 else float(row.filters.sd[-1]),
        }
        for row in comparison.rows
    ]
    plain = [{name: None if isinstance(value, float) and not np.isfinite(value) else value for name, value in row.items()} for row in rows]
    window = {"first_frame": comparison.first, "last_frame": comparison.last, "preferred": comparison.preferred}
    return window | {"sentence": window_verdict(comparison), "models": plain}
