"""Measures of a run's quality, for `summary.json`: overlap with the silhouettes, agreement of the runs, and error and coverage against the truth."""

from bayes_body.results.metrics.figures import accuracy_figures
from bayes_body.results.metrics.fit import silhouette_overlap
from bayes_body.results.metrics.summary import log_evidence, marker_disagreement, peak_memory_mb, summarise
from bayes_body.results.metrics.truth import against_truth, draws_against_truth, true_markers

__all__ = [
    "accuracy_figures",
    "against_truth",
    "draws_against_truth",
    "log_evidence",
    "marker_disagreement",
    "peak_memory_mb",
    "silhouette_overlap",
    "summarise",
    "true_markers",
]
