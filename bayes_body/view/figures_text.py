"""The figures of a run in a few lines for a terminal, with their units."""

from collections.abc import Mapping
from typing import Any


def figures_text(summary: Mapping[str, Any]) -> str:
    """The figures with their units. A figure that does not exist is a dash; without a truth there is no line on the error.

    Args:
        summary: the content of `summary.json`.
    """

    def shown(key: str, form: str, unit: str = "") -> str:
        return "-" if summary[key] is None else f"{summary[key]:{form}}{unit}"

    lines = [
        f"frames      {summary['frames']}, lost {summary['frames_lost']}; {summary['cameras']} cameras, {summary['dof']} dofs",
        f"time        {shown('seconds_per_frame', '.3f', ' s')} a frame; compilation {shown('seconds_compile', '.1f', ' s')}; "
        f"{shown('evaluations_per_second', ',.0f')} evaluations/s; {shown('peak_memory_mb', ',.0f', ' MB')}",
        f"particles   effective {shown('ess_median', '.0f')} (median), {shown('ess_min', '.0f')} (least) of {summary['particles']}",
        f"agreement   overlap with the silhouettes (IoU) {shown('iou_median', '.3f')}; R-hat over runs at most {shown('rhat_max', '.2f')}; "
        f"mean markers of the runs {shown('marker_disagreement_mm', '.0f', ' mm')} apart",
    ]
    return "\n".join([*lines, *_accuracy(summary)])


def warning_line(sentence: str) -> str:
    """A warning as a line below the figures."""
    return f"warning     {sentence}"


def _accuracy(summary: Mapping[str, Any]) -> list[str]:
    """The line on the truth. A summary that an older version wrote has no such keys."""
    found = {key: value for key, value in summary.items() if key.startswith(("error_", "coverage_")) and value is not None}
    if "error_mm_mean" not in found:
        return []
    errors = [
        f"{what} {found[key]:.0f} mm"
        for key, what in (
            ("error_mm_std", "sd over the frames"),
            ("error_mm_optimistic", "best particle"),
            ("error_mm_relative", "pelvis on pelvis"),
            ("error_mm_mean_fitted_offset", "skeletons' offset fitted"),
        )
        if key in found
    ]
    held = [f"{100 * found[key]:.0f} % of it inside the {level} % intervals" for level in (50, 90) if (key := f"coverage_{level}") in found]
    parts = [", ".join([f"{found['error_mm_mean']:.0f} mm from the truth", *errors]), *([", ".join(held)] if held else [])]
    return [f"accuracy    {'; '.join(parts)}"]
