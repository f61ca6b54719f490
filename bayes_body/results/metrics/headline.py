"""The figure that heads a run: of what it was fitted to."""

from collections.abc import Mapping
from typing import Any

from bayes_body.base.registry import OTHER


def shows_overlap(summary: Mapping[str, Any]) -> bool:
    """Return whether the overlap with the silhouettes says how well a run fits: it was fitted to them, or it is unknown to what it was."""
    reads = summary.get("reads")
    return reads is None or not {"silhouettes", OTHER}.isdisjoint(reads)


def shows_reprojection(summary: Mapping[str, Any]) -> bool:
    """Return whether the run was fitted to keypoints and has their reprojection error."""
    return "keypoints" in (summary.get("reads") or ()) and summary.get("reprojection_px_median") is not None
