"""What a model reads of the images, so that a run is headed by a figure of what it was fitted to."""

from collections.abc import Mapping
from typing import Any

from bayes_body.model.build import Model

# By the kind of a likelihood; the terms of `silhouette_edges` can be chosen. A kind that is not listed is a plugin's.
KINDS = {
    "markers_gaussian": ("keypoints",),
    "silhouette_bernoulli": ("silhouettes",),
    "silhouette_edges": ("silhouettes", "edges"),
    "regions": ("silhouettes",),
    "edge_phase": ("edges",),
    "image_motion": ("image motion",),
}
PLUGIN = "other"


def evidence_read(model: Model) -> list[str]:
    """Return what the model's likelihoods compare the body with: keypoints, silhouettes, edges, image motion, or `other` for a plugin's term."""
    read = set[str]()
    for term in model.definition.likelihoods:
        edges_only = tuple(getattr(term.options, "terms", ())) == ("edges",)
        read |= {"edges"} if edges_only else {*KINDS.get(term.kind, (PLUGIN,))}
    return sorted(read)


def shows_overlap(summary: Mapping[str, Any]) -> bool:
    """Return whether the overlap with the silhouettes says how well a run fits: it was fitted to them, or it is unknown to what it was."""
    reads = summary.get("reads")
    return reads is None or not {"silhouettes", PLUGIN}.isdisjoint(reads)


def shows_reprojection(summary: Mapping[str, Any]) -> bool:
    """Return whether the run was fitted to keypoints and has their reprojection error."""
    return "keypoints" in (summary.get("reads") or ()) and summary.get("reprojection_px_median") is not None
