"""The figures of a run as a few lines of text for a terminal, with units."""

from collections.abc import Mapping
from typing import Any

from bayes_body.results.metrics.summary import shows_overlap, shows_reprojection
from bayes_body.results.metrics.unknown_sentences import unknown_lines


def figures_text(summary: Mapping[str, Any]) -> str:
    """Return the figures with their units. A figure that does not exist is a dash; without a truth there is no line about the error.

    Args:
        summary: the content of `summary.json`.
    """

    def shown(key: str, form: str, unit: str = "") -> str:
        return "-" if summary[key] is None else f"{summary[key]:{form}}{unit}"

    fitted = f"overlap with the silhouettes (IoU) {shown('iou_median', '.3f')}; " if shows_overlap(summary) else ""
    if shows_reprojection(summary):
        fitted = f"reprojection error of the keypoints {shown('reprojection_px_median', '.1f', ' px')} (median); {fitted}"
    cameras = f"{summary['cameras']} camera{'s' if summary['cameras'] > 1 else ''}"
    off = len(summary.get("frames_off") or [])
    beside_person = f", off the person {off}" if off else ""
    lines = [
        f"frames      {summary['frames']}, lost {summary['frames_lost']}{beside_person}; {cameras}, {summary['dof']} dofs",
        f"time        {shown('seconds_per_frame', '.3f', ' s')} a frame; compilation {shown('seconds_compile', '.1f', ' s')}; "
        f"{shown('evaluations_per_second', ',.0f')} evaluations/s; {shown('peak_memory_mb', ',.0f', ' MB')}",
        f"particles   effective {shown('ess_median', '.0f')} (median), {shown('ess_min', '.0f')} (minimum) of {summary['particles']}",
        f"agreement   {fitted}R-hat over runs at most {shown('rhat_max', '.2f')}; "
        f"mean markers of the runs {shown('marker_disagreement_mm', '.0f', ' mm')} apart",
    ]
    return "\n".join([*lines, *_redone(summary), *_joint(summary), *unknown_lines(summary), *_accuracy(summary)])


def warning_line(sentence: str) -> str:
    """Return a warning as a line below the figures."""
    return f"warning     {sentence}"


def _redone(summary: Mapping[str, Any]) -> list[str]:
    """Return the line about frames that the kernel `laplace` did again; other kernels have none."""
    if summary.get("redone_starts_share") is None:
        return []
    starts, tempered = (100 * summary[f"redone_{how}_share"] for how in ("starts", "tempered"))
    doubtful = summary.get("normal_doubtful_share")
    doubt = f"; a normal distribution fits {100 * doubtful:.1f} % badly (Pareto k above 0.7)" if doubtful else ""
    return [f"done again  {starts:.1f} % of the frames from more starts, {tempered:.1f} % by the kernel tempered{doubt}"]


def _joint(summary: Mapping[str, Any]) -> list[str]:
    """Return the line about the Gaussian of all frames; draws that come another way have none."""
    if summary.get("joint_steps_max") is None:
        return []
    ended = "converged" if summary["joint_converged_share"] == 1 else "not converged"
    share = summary["joint_pareto_k_share"]
    windows = "Pareto k unknown" if share is None else f"Pareto k at most 0.7 in windows about {100 * share:.0f} % of the frames"
    return [f"joint       {ended} after {summary['joint_steps_max']:.0f} Newton steps; {windows}"]


def _accuracy(summary: Mapping[str, Any]) -> list[str]:
    """Return the line about the truth. A summary from an older version does not have these keys."""
    figures = {key: value for key, value in summary.items() if key.startswith(("error_", "coverage_")) and value is not None}
    if "error_mm_mean" not in figures:
        return []
    errors = [
        f"{wording} {figures[key]:.0f} mm"
        for key, wording in (
            ("error_mm_std", "sd over the frames"),
            ("error_mm_optimistic", "best particle"),
            ("error_mm_relative", "relative to the pelvis"),
            ("error_mm_mean_fitted_offset", "with the skeletons' offset fitted"),
        )
        if key in figures
    ]
    covered = [
        f"{100 * figures[key]:.0f} % of the truth inside the {level} % intervals" for level in (50, 90) if (key := f"coverage_{level}") in figures
    ]
    if summary.get("ece_radial") is not None:
        marker, worst = next(iter(summary["ece_radial_by_marker"].items()))
        covered.append(f"calibration error {summary['ece_radial']:.2f} (worst {marker}, {worst:.2f})")
    parts = [", ".join([f"{figures['error_mm_mean']:.0f} mm from the truth", *errors]), *([", ".join(covered)] if covered else [])]
    return [f"accuracy    {'; '.join(parts)}"]
