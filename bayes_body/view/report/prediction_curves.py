"""Plots of the posterior predictive check over time: a panel for each camera."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from bayes_body.base.errors import escaped
from bayes_body.view.colours import GREY, INK, run_line
from bayes_body.view.report.figures import encoded, new_panel, shade_lost, time_axis, time_label
from bayes_body.view.report.inspection import Inspection
from bayes_body.view.report.markup import Picture
from bayes_body.view.report.predicted_keypoints import KeypointCheck

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SIZE = (3.6, 2.3)
LINE = {"marker": "o", "markersize": 3}


def error_panels(it: Inspection, frames: Int[np.ndarray, " frame"], check: KeypointCheck) -> Iterator[Picture]:
    """Yield for each camera the errors of the keypoints, over a band of the errors that are predicted."""
    seeker = it.diagnosis.mode_seeker
    middle, high = (percentiles(check.error, share) for share in (50, 90))
    top = 1.08 * max(float(np.nanmax(high)), 1.0, 0.0 if seeker else float(np.nanmax(check.expected[..., 1])))
    for c, name in enumerate(cameras(it)):
        if not np.isfinite(check.error[:, c]).any():
            continue
        figure, axes = new_panel(f"Camera {escaped(name)}", time_label(it.fps), "reprojection error, px", SIZE)
        shade_lost(axes, it.lost)
        if not seeker:
            _band(axes, frames, np.zeros(len(frames)), check.expected[:, c, 1])
        axes.plot(frames, middle[:, c], color=INK, label="median", **LINE)
        axes.plot(frames, high[:, c], color=INK, linestyle=run_line(2), label="90 % quantile", **LINE)
        axes.set_ylim(0, top)
        _finish(it, axes)
        yield encoded(figure, f"Reprojection error in camera {name} over time: median {median(check.error[:, c]):.1f} px.")


def silhouette_panels(
    it: Inspection,
    frames: Int[np.ndarray, " frame"],
    what: str,
    label: str,
    values: Float[np.ndarray, "frame camera draw"],
    expected: Float[np.ndarray, "frame camera end"],
) -> Iterator[Picture]:
    """Yield for each camera a figure of the silhouettes, over a band of what is predicted, if anything is.

    Args:
        it: the run.
        frames: the compared frames.
        what: `overlap` or `area`.
        label: of the vertical axis.
        values: the figure of each draw.
        expected: the ends of its predictive interval; NaN if there is none.
    """
    # The worst value.
    reach = max(1.1 * float(np.nanmax(np.abs(np.append(values, expected)))), 10.0)
    low, middle, high = (percentiles(values, share) for share in (5, 50, 95))
    for c, name in enumerate(cameras(it)):
        if not np.isfinite(values[:, c]).any():
            continue
        figure, axes = new_panel(f"Camera {escaped(name)}: {what}", time_label(it.fps), label, SIZE)
        shade_lost(axes, it.lost)
        if np.isfinite(expected[:, c]).any():
            _band(axes, frames, expected[:, c, 0], expected[:, c, 1])
        if not it.diagnosis.mode_seeker:
            axes.vlines(frames, low[:, c], high[:, c], color=INK, alpha=0.3, linewidth=5)
        axes.plot(frames, middle[:, c], color=INK, **LINE)
        if what == "area":
            axes.axhline(0, color=GREY, linewidth=0.9)
        axes.set_ylim(*((-reach, reach) if what == "area" else (0, 1.02)))
        _finish(it, axes)
        yield encoded(figure, f"Silhouettes of camera {name} over time, {label}: median {median(values[:, c]):.3g}.")


def _band(axes: "Axes", frames: Int[np.ndarray, " frame"], low: Float[np.ndarray, " frame"], high: Float[np.ndarray, " frame"]) -> None:
    if len(frames) > 1:
        axes.fill_between(frames, low, high, color=GREY, alpha=0.25, linewidth=0)
    else:
        axes.vlines(frames, low, high, color=GREY, alpha=0.4, linewidth=9)


def _finish(it: Inspection, axes: "Axes") -> None:
    time_axis(axes, it.run.frames, it.fps)
    if it.run.frames > 12:
        # The first and the last compared frame are the recording's: their marks must not be cut.
        axes.margins(x=0.02)
        axes.set_xlim(-0.02 * it.run.frames, 1.02 * (it.run.frames - 1))


def cameras(it: Inspection) -> list[str]:
    """Return the names of the cameras."""
    return [view.camera.name for view in it.run.session.views]


def median(values: Float[np.ndarray, "..."]) -> float:
    """Return the median of what is known; NaN if nothing is."""
    return percentile(values, 50)


def percentile(values: Float[np.ndarray, "..."], share: int) -> float:
    """Return the percentile of what is known; NaN if nothing is."""
    known = values[np.isfinite(values)]
    return float(np.percentile(known, share)) if known.size else float("nan")


def percentiles(values: Float[np.ndarray, "*some each"], share: int) -> Float[np.ndarray, "*some"]:
    """Return the percentile over the last axis of what is known; NaN if nothing is."""
    flat = values.reshape(-1, values.shape[-1])
    return np.array([percentile(row, share) for row in flat]).reshape(values.shape[:-1])
