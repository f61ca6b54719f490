"""A frame's keypoints as markers: what `markers_gaussian` reads."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from bayes_body.base.errors import input_error
from bayes_body.base.registry import register
from bayes_body.base.toml.schema import Schema
from bayes_body.recording.evidence.markers import MARKERS, CandidateEvidence, MarkerEvidence, evidence_names
from bayes_body.recording.observation.frames import Frame


class Options(Schema):
    """`[likelihood.observation]` of `markers_gaussian` has no options."""


@register("observation", "markers_gaussian", Options)
def build(markers: Sequence[str] = MARKERS, **_: Any) -> Callable[[Frame], MarkerEvidence | CandidateEvidence]:
    """Extract the markers of a body that has these markers from a frame's keypoints, as NumPy arrays.

    Where the session knows several people, the evidence has the detections that may be the subject's.
    """
    names = evidence_names(markers)

    def observe(frame: Frame) -> MarkerEvidence | CandidateEvidence:
        if frame.keypoints is None:
            remedy = "import them with the recording, or give [[camera]] its `keypoints`"
            raise input_error("session.toml", "its cameras have no keypoints", "keypoints from at least one camera", remedy)
        if frame.candidates is not None:
            rows = np.array([[_rows(names, keypoints) for keypoints, _ in candidates] for candidates in frame.candidates], np.float32)
            shares = np.array([[share for _, share in candidates] for candidates in frame.candidates], np.float32)
            return CandidateEvidence(rows[..., :2], rows[..., 2], shares)
        rows = np.array([_rows(names, keypoints or {}) for keypoints in frame.keypoints], np.float32)
        return MarkerEvidence(rows[..., :2], rows[..., 2])

    return observe


def _rows(names: Sequence[str], keypoints: Mapping[str, tuple[float, float, float]]) -> list[tuple[float, float, float]]:
    return [keypoints.get(name, (0.0, 0.0, 0.0)) for name in names]
