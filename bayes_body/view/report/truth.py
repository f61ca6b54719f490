"""The run against the true markers: how large the error is, whether the run knew it, and which markers make it."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from bayes_body.errors import InputError
from bayes_body.metrics.accuracy import LEVELS
from bayes_body.metrics.figures import accuracy_figures, width
from bayes_body.metrics.truth import AgainstTruth, Cloud, Clouds, against_truth, mean_known, true_markers
from bayes_body.posterior.blocks import pose_blocks
from bayes_body.view.report.bands import sparse_frames
from bayes_body.view.report.figures import INK, LEGEND, RUNS, encoded, frame_label, frames_a_point, new_panel, shade_lost, whole_frames
from bayes_body.view.report.inspection import Inspection
from bayes_body.view.report.limbs import spoken
from bayes_body.view.report.markup import Markup, Picture, figures, section, table, tag

if TYPE_CHECKING:
    from bayes_body.storage.saved_run import SavedRun

ERROR = "A line is a run's error: the distance of its mean markers from the true ones, mean over the markers."
EXPECTED = (
    "The bands are what the runs themselves expect: how far a draw lies from the mean, the middle half (strong) and 90 % (faint). A run that knows "
    "what it does not know stays inside the faint band in nine frames of ten."
)
SEEKER = "There are no bands and no coverage: the spread of a mode seeker's particles is no uncertainty."
CALIBRATION = (
    "Of intervals that claim a share, the share that holds the truth, over frames, markers and axes. On the dashed line the run keeps its word; "
    "below it the intervals are too narrow, above it too wide."
)
OFFSET = (
    "The joint centres of two skeletons are never the same. The offset is what differs at a joint in all frames alike; it is fitted on every other "
    "frame and taken away in those between. Its length is that of all frames together."
)
DETAILS = (("error_mm_relative", "with the pelvises laid on each other"), ("error_mm_optimistic", "of the best particle of each frame"))


def truth_section(it: Inspection) -> Markup:
    """Sentences, the error over the frames, coverage, and the markers one by one; a sentence where the truth can no longer be read."""
    title = "Against the truth"
    try:
        found = measured(it.run)
    except InputError as error:
        return section("truth", title, tag("p", f"The run cannot be held against the truth any more: {error}."))
    if found is None or not found.plain.known.any():
        return section("truth", title, tag("p", "None of the body's markers has a true position in the frames of this run."))
    seeker, step = it.diagnosis.mode_seeker, frames_a_point(it.run.frames)
    pictures = [_error(it, found), *([] if seeker else [_calibration(found)])]
    parts = [
        *(tag("p", sentence) for sentence in told(found, seeker)),
        figures(pictures),
        tag("h3", "Marker by marker"),
        *([tag("p", OFFSET)] if found.fitted else []),
        _by_marker(found, seeker),
        *([tag("p", f"Measured in {sparse_frames(step)} frame of {it.run.frames:,}; summary.json has all.", class_="note")] if step > 1 else []),
    ]
    return section("truth", title, *parts)


def measured(run: "SavedRun") -> AgainstTruth | None:
    """The run against its session's truth, at no more frames than a line has points, evenly spaced; None where there is no truth.

    Raises:
        InputError: the truth, the session or the body can no longer be read.
    """
    truth = true_markers(run.session)
    if truth is None:
        return None
    frames = range(0, run.frames, frames_a_point(run.frames))
    return against_truth(run.model, _clouds(run, frames), truth[frames.start : frames.stop : frames.step])


def _clouds(run: "SavedRun", frames: range) -> Clouds:
    def call() -> Iterator[Cloud]:
        for piece in pose_blocks(run.tree, frames):
            yield from (Cloud(piece.poses[:, :, place], piece.log_weights[:, :, place]) for place in range(len(piece.frames)))

    return call


def told(found: AgainstTruth, mode_seeker: bool) -> list[str]:
    """The figures in sentences: the error, what the intervals hold, and what an offset of the skeletons explains.

    Args:
        found: the run against the truth; some of it is known.
        mode_seeker: whether the kernel is one.
    """
    it = accuracy_figures(found, mode_seeker)
    details = [f"{what} {it[key]:.0f} mm" for key, what in DETAILS if it[key] is not None]
    spread = "" if it["error_mm_std"] is None else f" (standard deviation over the frames {it['error_mm_std']:.0f} mm)"
    sentences = [f"The mean markers are {it['error_mm_mean']:.0f} mm from the true ones{spread}; {', '.join(details)}."]
    if mode_seeker:
        sentences.append(SEEKER)
    else:
        half, most = it["coverage_50"], it["coverage_90"]
        sentences.append(
            f"The 90 % intervals hold the truth in {percent(most)} of cases: {width(most)}. The 50 % intervals hold it in {percent(half)}."
        )
    if it["error_mm_mean_fitted_offset"] is not None:
        held = "" if mode_seeker else f", and the 90 % intervals hold the truth in {percent(it['coverage_90_fitted_offset'])} of cases"
        sentences.append(f"With the offset between the two skeletons fitted the error is {it['error_mm_mean_fitted_offset']:.0f} mm{held}.")
    return sentences


def _error(it: Inspection, found: AgainstTruth) -> Picture:
    """A line a run over what the runs expect."""
    step = frames_a_point(it.run.frames)
    figure, axes = new_panel("Error", frame_label(it.fps, sparse_frames(step)), "mean over the markers, mm")
    frames, error = np.arange(0, it.run.frames, step), 1000 * found.plain.frame_error.T
    mark = {"marker": "o", "markersize": 3.5} if len(frames) <= 12 else {}
    shade_lost(axes, it.lost)
    if not it.diagnosis.mode_seeker:
        low, first, third, high = 1000 * found.plain.expected.T
        axes.fill_between(frames, low, high, color=INK, alpha=0.12, linewidth=0)
        axes.fill_between(frames, first, third, color=INK, alpha=0.2, linewidth=0)
    for run, line in enumerate(error):
        axes.plot(frames, line, color=RUNS[run % len(RUNS)], label=f"run {run + 1}", **mark)
    whole_frames(axes, it.run.frames)
    axes.set_ylim(bottom=0)
    if 1 < len(error) <= LEGEND:
        axes.legend(loc="best", ncols=3, handlelength=1.2, columnspacing=1.0)
    alt = f"Error of the mean markers over the frames, from {np.nanmin(error):.0f} to {np.nanmax(error):.0f} mm."
    return encoded(figure, alt, ERROR if it.diagnosis.mode_seeker else f"{ERROR} {EXPECTED}")


def _calibration(found: AgainstTruth) -> Picture:
    """Nominal coverage across, what was found upwards."""
    figure, axes = new_panel("Coverage", "the interval claims, %", "of the truth inside, %")
    axes.plot([0, 100], [0, 100], color=INK, linestyle="--", linewidth=0.9)
    nominal = 100 * np.array(LEVELS)
    axes.plot(nominal, 100 * found.plain.coverage, color=RUNS[0], marker="o", markersize=3.5, label="as it is")
    if found.fitted:
        axes.plot(nominal, 100 * found.fitted.coverage, color=RUNS[1], marker="s", markersize=3.5, label="offset fitted")
        axes.legend(loc="upper left")
    axes.set(xlim=(0, 100), ylim=(0, 102))
    pairs = ", ".join(f"{percent(level)}: {percent(share)}" for level, share in zip(LEVELS, found.plain.coverage, strict=True))
    return encoded(figure, f"Share of the truth inside the intervals of each level: {pairs}.", CALIBRATION)


def _by_marker(found: AgainstTruth, mode_seeker: bool) -> Markup:
    """Largest error first; what does not exist has no column."""
    plain, fitted = found.plain, found.fitted
    columns = [("error, mm", _mm(mean_known(plain.error, (0, 1))))]
    if fitted:
        columns.append(("offset fitted, mm", _mm(mean_known(fitted.error, (0, 1)))))
        columns.append(("length of the offset, mm", _mm(np.linalg.norm(found.offsets, axis=-1))))
    if not mode_seeker:
        held = plain.coverage_by_marker
        columns += [(f"inside {percent(level)}", [percent(share) for share in held[LEVELS.index(level)]]) for level in (0.5, 0.9)]
    order = np.argsort(-np.nan_to_num(mean_known(plain.error, (0, 1)), nan=-1.0), kind="stable")
    rows = [[spoken(plain.names[place]), *(cells[place] for _, cells in columns)] for place in order]
    return table(["marker", *(name for name, _ in columns)], rows)


def _mm(metres: Float[np.ndarray, " marker"]) -> list[str]:
    return ["–" if np.isnan(value) else f"{1000 * value:.0f}" for value in metres]


def percent(share: float) -> str:
    """The share in per cent, or a dash where there is none."""
    return "–" if np.isnan(share) else f"{100 * share:.0f} %"
