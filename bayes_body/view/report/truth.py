"""The section that compares a run with the true markers: the error, the coverage of the intervals, and the error of each marker."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import InputError, input_error
from bayes_body.results.metrics.accuracy import LEVELS
from bayes_body.results.metrics.angles import AngleAccuracy, true_angles
from bayes_body.results.metrics.calibration import CERTAIN, NOMINAL, Scores, calibration_curves, calibration_errors, error_by_certainty, tarp
from bayes_body.results.metrics.clouds import Cloud, Clouds
from bayes_body.results.metrics.figures import accuracy_figures, width
from bayes_body.results.metrics.truth import Accuracy, AgainstTruth, against_truth, mean_known, true_markers
from bayes_body.results.posterior.blocks import placing_blocks
from bayes_body.view.colours import GREY, INK, run_line
from bayes_body.view.report.bands import sparse_frames
from bayes_body.view.report.figures import encoded, frames_a_point, new_panel, point_marks, run_label, time_label
from bayes_body.view.report.inspection import Inspection, spoken
from bayes_body.view.report.markup import Markup, Picture, figures, section, table, tag
from bayes_body.view.report.panels import frame_panel

if TYPE_CHECKING:
    from bayes_body.results.storage.saved_run import SavedRun

ERROR = "Each line is the error of a run: the distance of its mean markers from the true ones, averaged over the markers."
EXPECTED = (
    "The band shows the error that the runs expect, which is the distance of a draw from the mean. If the posterior is calibrated, the error is "
    "in the band in nine of ten frames."
)
SEEKER = "There is no band and no coverage: the spread of a mode seeker's particles is not a measure of uncertainty."
CALIBRATION = (
    "Coverage: the fraction of intervals of each nominal level that contain the truth, over frames, markers and axes. On the grey line the "
    "intervals are right. Below it they are too narrow, and above it too wide."
)
OFFSET = (
    "The joint centres of two skeletons are never exactly the same. The offset is the part of the difference at a joint that is constant over the "
    "frames. It is fitted on every other frame and subtracted in the frames between. The table gives its length as fitted on all frames together."
)
RADIAL = (
    "Calibration by distance: the fraction of truths that are nearer to the draws' median than the fraction of draws on the horizontal axis. Each "
    "grey curve is a marker. Below the diagonal the posterior is too narrow, above it too wide. The median over the markers hides bad markers."
)
CERTAINTY = (
    "Error of the most certain frames, those with the smallest spread of the markers: it falls to the left if the spread knows where the errors are."
)
ANGLES = "The true angles are those with which the body follows the motion that was filmed."
DETAILS = (("error_mm_relative", "relative to the pelvis"), ("error_mm_optimistic", "for the best particle of each frame"))


def truth_section(inspection: Inspection) -> Markup:
    """Return the section: sentences, the error over the frames, coverage, and a table of markers; a sentence if the truth can no longer be read."""
    title = "Comparison with the truth"
    try:
        comparison = measured(inspection.run)
    except InputError as error:
        return section("truth", title, tag("p", f"The run can no longer be compared with the truth: {error}."))
    if comparison is None or not comparison.plain.known.any():
        return section("truth", title, tag("p", "None of the body's markers has a true position in the frames of this run."))
    seeker, step = inspection.diagnosis.mode_seeker, frames_a_point(inspection.run.frames)
    pictures = [_error(inspection, comparison), *([] if seeker else [_calibration(comparison), *_scores(comparison.plain)])]
    parts = [
        *(tag("p", sentence) for sentence in describe_accuracy(comparison, seeker)),
        figures(pictures),
        tag("h3", "Error of each marker"),
        *([tag("p", OFFSET)] if comparison.fitted else []),
        _by_marker(comparison, seeker),
        *([] if comparison.angles is None else [tag("h3", "Error of each angle"), tag("p", ANGLES), _by_angle(comparison.angles, seeker)]),
        *(
            [tag("p", f"Measured in {sparse_frames(step)} frame of {inspection.run.frames:,}; summary.json has all.", class_="note")]
            if step > 1
            else []
        ),
    ]
    return section("truth", title, *parts)


def measured(run: "SavedRun") -> AgainstTruth | None:
    """Compare the run with its session's truth, at no more than MOST_POINTS evenly spaced frames; None if there is no truth.

    Raises:
        InputError: the truth, the session or the body can no longer be read, or the truth has changed since the run was made.
    """
    if "truth" in run.changed_inputs:
        raise input_error(f"{run.session.truth_path}", "not the file of the time of the run", "that file", "restore it")
    truth = true_markers(run.session)
    if truth is None:
        return None
    frames = range(0, run.frames, frames_a_point(run.frames))
    angles = true_angles(run.session, run.model)
    chosen_angles = None if angles is None else angles.select(frames)
    return against_truth(run.model, _clouds(run, frames), truth[frames.start : frames.stop : frames.step], chosen_angles)


def _clouds(run: "SavedRun", frames: range) -> Clouds:
    def call() -> Iterator[Cloud]:
        for piece, changes in placing_blocks(run.tree, run.model.placing, frames):
            for place in range(len(piece.frames)):
                values = {name: change[:, :, place] for name, change in changes.items()}
                yield Cloud(piece.poses[:, :, place], piece.log_weights[:, :, place], values)

    return call


def describe_accuracy(comparison: AgainstTruth, mode_seeker: bool) -> list[str]:
    """Return the figures in sentences: the error, the coverage, and the error with the skeletons' offset fitted.

    Args:
        comparison: the run compared with the truth; at least some of the truth is known.
        mode_seeker: whether the kernel is a mode seeker.
    """
    inspection = accuracy_figures(comparison, mode_seeker)
    details = [f"{label} {inspection[key]:.0f} mm" for key, label in DETAILS if inspection[key] is not None]
    spread = "" if inspection["error_mm_std"] is None else f" (standard deviation over the frames {inspection['error_mm_std']:.0f} mm)"
    sentences = [f"The mean markers are {inspection['error_mm_mean']:.0f} mm from the true ones{spread}; {', '.join(details)}."]
    if mode_seeker:
        sentences.append(SEEKER)
    else:
        most = inspection["coverage_90"]
        sentences.append(f"The 90 % intervals contain the truth in {percent(most)} of cases: {width(most)}.")
        sentences.extend(_of_all_markers(comparison.plain))
    if inspection["error_mm_mean_fitted_offset"] is not None:
        coverage = "" if mode_seeker else f", and the 90 % intervals contain the truth in {percent(inspection['coverage_90_fitted_offset'])} of cases"
        sentences.append(
            f"With the offset between the two skeletons fitted, the error is {inspection['error_mm_mean_fitted_offset']:.0f} mm{coverage}."
        )
    return sentences


def _of_all_markers(plain: Accuracy) -> list[str]:
    """Return the sentence on the joint distribution of all markers; none with too few independent frames."""
    joint = None if plain.scores is None else tarp(plain.scores.rank, plain.frame_error)
    if joint is None:
        return []
    frames = f"{joint.frames} frames far enough apart"
    sentence = f"All markers together (TARP): coverage differs by {joint.deviation:+.2f} (sd {joint.sd:.2f}, {frames}) from level {joint.level:.2f}"
    return [f"{sentence}: {joint.verdict}."]


def _error(inspection: Inspection, comparison: AgainstTruth) -> Picture:
    """Return the plot of the error: one line for each run, over a band of the error that the runs expect."""
    step = frames_a_point(inspection.run.frames)
    label = time_label(inspection.fps, f"{sparse_frames(step)} frame" if step > 1 else "")
    figure, axes = frame_panel(inspection, "Error", label, "mean over the markers, mm")
    frames, error = np.arange(0, inspection.run.frames, step), 1000 * comparison.plain.frame_error.T
    if not inspection.diagnosis.mode_seeker:
        low, *_, high = 1000 * comparison.plain.expected.T
        axes.fill_between(frames, low, high, color=GREY, alpha=0.25, linewidth=0)
    for run, line in enumerate(error):
        axes.plot(frames, line, color=INK, linestyle=run_line(run), label=run_label(run, len(error)), **point_marks(len(frames)))
    axes.set_ylim(bottom=0)
    alt = f"Error of the mean markers over the frames, from {np.nanmin(error):.0f} to {np.nanmax(error):.0f} mm."
    return encoded(figure, alt, ERROR if inspection.diagnosis.mode_seeker else f"{ERROR} {EXPECTED}")


def _calibration(comparison: AgainstTruth) -> Picture:
    """Return the plot of the measured coverage over the nominal coverage."""
    figure, axes = new_panel("Coverage", "nominal, %", "measured, %")
    axes.plot([0, 100], [0, 100], color=GREY, linewidth=0.9)
    nominal = 100 * np.array(LEVELS)
    axes.plot(nominal, 100 * comparison.plain.coverage, color=INK, marker="o", markersize=3.5, label="as it is" if comparison.fitted else None)
    if comparison.fitted:
        axes.plot(nominal, 100 * comparison.fitted.coverage, color=INK, linestyle=run_line(1), marker="s", markersize=3.5, label="offset fitted")
    axes.set(xlim=(0, 100), ylim=(0, 102))
    pairs = ", ".join(f"{percent(level)}: {percent(share)}" for level, share in zip(LEVELS, comparison.plain.coverage, strict=True))
    return encoded(figure, f"Fraction of the truth inside the intervals of each level: {pairs}.", CALIBRATION)


def _scores(plain: Accuracy) -> list[Picture]:
    """Return the plots of the calibration by distance and of the error by certainty."""
    return [] if plain.scores is None else [_radial(plain.names, plain.scores), _certainty(plain, plain.scores)]


def _radial(names: tuple[str, ...], scores: Scores) -> Picture:
    curves, errors = calibration_curves(scores.level), calibration_errors(scores.level)
    finite = np.flatnonzero(np.isfinite(errors))
    worst = finite[errors[finite].argmax()]
    figure, axes = new_panel("Calibration by distance", "draws, %", "truths, %")
    axes.plot(100 * NOMINAL, 100 * curves[:, finite], color=GREY, linewidth=0.7, alpha=0.6)
    axes.plot([0, 100], [0, 100], color=GREY, linewidth=0.9)
    axes.plot(100 * NOMINAL, 100 * np.median(curves[:, finite], axis=1), color=INK, label="median")
    if len(finite) > 1:
        axes.plot(100 * NOMINAL, 100 * curves[:, worst], color=INK, linestyle=run_line(1), label=f"worst: {spoken(names[worst])}")
    axes.set(xlim=(0, 100), ylim=(0, 102))
    axes.legend(loc="best")
    alt = f"Expected calibration error: median over the markers {np.median(errors[finite]):.2f}, worst {errors[worst]:.2f} of {spoken(names[worst])}."
    return encoded(figure, alt, f"{RADIAL} {alt}")


def _certainty(plain: Accuracy, scores: Scores) -> Picture:
    error_mm = 1000 * error_by_certainty(plain.error, scores.spread)
    figure, axes = new_panel("Error by certainty", "most certain frames, %", "mean over the markers, mm")
    axes.plot(100 * CERTAIN, error_mm, color=INK, marker="o", markersize=3.5)
    axes.set(xlim=(0, 102))
    axes.set_ylim(0, 1.1 * error_mm.max())
    return encoded(
        figure, f"Mean error from {error_mm[0]:.0f} mm in the most certain tenth of the frames to {error_mm[-1]:.0f} mm in all.", CERTAINTY
    )


def _by_angle(angles: AngleAccuracy, mode_seeker: bool) -> Markup:
    """Return the table of clinical angles, largest error first."""
    rms, coverage = angles.rms_deg, angles.coverage[LEVELS.index(0.9)]
    order = np.argsort(-rms, kind="stable")
    heads = ["angle", "root mean square error, degrees", *([] if mode_seeker else ["inside 90\u00a0%"])]
    return table(heads, [[spoken(angles.names[k]), f"{rms[k]:.1f}", *([] if mode_seeker else [percent(coverage[k])])] for k in order])


def _by_marker(comparison: AgainstTruth, mode_seeker: bool) -> Markup:
    """Return the table of markers, largest error first; figures that do not exist have no column."""
    plain, fitted = comparison.plain, comparison.fitted
    columns = [("error, mm", _mm(mean_known(plain.error, (0, 1))))]
    if fitted:
        columns.append(("offset fitted, mm", _mm(mean_known(fitted.error, (0, 1)))))
        columns.append(("length of the offset, mm", _mm(np.linalg.norm(comparison.offsets, axis=-1))))
    if not mode_seeker:
        columns.append(("inside 90 %", [percent(share) for share in plain.coverage_by_marker[LEVELS.index(0.9)]]))
    order = np.argsort(-np.nan_to_num(mean_known(plain.error, (0, 1)), nan=-1.0), kind="stable")
    rows = [[spoken(plain.names[place]), *(cells[place] for _, cells in columns)] for place in order]
    return table(["marker", *(name for name, _ in columns)], rows)


def _mm(metres: Float[np.ndarray, " marker"]) -> list[str]:
    return ["–" if np.isnan(value) else f"{1000 * value:.0f}" for value in metres]


def percent(share: float) -> str:
    """Return the fraction in per cent, or a dash if there is none."""
    return "–" if np.isnan(share) else f"{100 * share:.0f} %"
