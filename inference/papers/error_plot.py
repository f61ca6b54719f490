"""Plot the errors of found or tracked people: by frame, and how many frames have at most an error (Sigal et al. 2011, section 9)."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bayes_body.base.files.atomic import replacing
from bayes_body.view.colours import GREY, INK, WARNING, run_line

# The limits of the paper's Table 3, metres: poses below them have this name.
LIMITS_M = {"correct": 0.08, "acceptable": 0.12}


def draw_error_curves(path: Path, panels: Mapping[str, Mapping[str, Float[np.ndarray, "run frame"]]]) -> None:
    """Write a .png with a panel for each kind of error: its mean over the runs by frame, and the range of the runs (Darby et al. 2008, Fig. 2).

    Args:
        path: the file.
        panels: by the kind of error, such as "absolute", then by what was compared: the errors, metres.

    Raises:
        InputError: the file cannot be written.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    figure = Figure(figsize=(5 * len(panels), 4), layout="constrained")
    for axes, (kind, compared) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True):
        for number, (name, errors) in enumerate(compared.items()):
            frames, mean = np.arange(errors.shape[1]), 1000 * errors.mean(axis=0)
            axes.plot(frames, mean, color=INK, linestyle=run_line(number), label=f"{name}: {mean.mean():.0f} mm")
            axes.fill_between(frames, 1000 * errors.min(axis=0), 1000 * errors.max(axis=0), color=GREY, alpha=0.2, linewidth=0)
        axes.set(title=f"{kind} error", xlabel="frame", ylabel="mean error of the markers, mm")
        axes.set_ylim(bottom=0)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.legend()
    with replacing(path) as partial:
        figure.savefig(partial, format="png", dpi=120)


def draw_errors(path: Path, frames: Sequence[int], error_m: Float[np.ndarray, " frame"]) -> None:
    """Write a .png of the errors of some frames. Purple lines are the limits of the paper's tables.

    Args:
        path: the file.
        frames: the frames' numbers.
        error_m: mean error of the markers, metres; NaN where there is none.

    Raises:
        InputError: the file cannot be written.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    error = 1000 * error_m
    known = np.sort(error[np.isfinite(error)])
    largest = 1.1 * max([1000 * LIMITS_M["acceptable"], *known])
    figure = Figure(figsize=(11, 4), layout="constrained")
    by_frame, share = figure.subplots(1, 2, width_ratios=(2, 1))
    by_frame.plot(frames, error, ".-", color=INK)
    by_frame.set(xlabel="frame", ylabel="mean error of the markers, mm", ylim=(0, largest))
    by_frame.xaxis.set_major_locator(MaxNLocator(integer=True))
    share.step([0, *known, largest], [*np.arange(len(known) + 1), len(known)] / np.maximum(len(error), 1), where="post", color=INK)
    share.set(xlabel="error, mm", ylabel="share of the frames with at most this error", ylim=(0, 1.02), xlim=(0, largest))
    for name, limit_m in LIMITS_M.items():
        by_frame.axhline(1000 * limit_m, color=WARNING)
        below = f"{name} below {1000 * limit_m:.0f} mm"
        by_frame.annotate(below, (0.01, 1000 * limit_m), (0, -3), by_frame.get_yaxis_transform(), "offset points", va="top")
        share.axvline(1000 * limit_m, color=WARNING)
    with replacing(path) as partial:
        figure.savefig(partial, format="png", dpi=120)
