"""Data shared by all parts of the page: the run, its diagnosis and its warnings, each computed on first use."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool

from bayes_body.base.errors import InputError
from bayes_body.base.progress import Watch, unwatched
from bayes_body.results.clinical.moments import Curves
from bayes_body.results.metrics.plausibility_sentences import fit_sentences
from bayes_body.results.posterior.diagnostics import Diagnosis, Thresholds, diagnose, sentences
from bayes_body.results.posterior.moments import Moments
from bayes_body.view.report.curves import FilterCurves, clinical_curves, dof_curves, filter_curves, units_of
from bayes_body.view.report.figures import frames_a_point, time_label
from bayes_body.view.report.predictive import Predicted, prediction_of

if TYPE_CHECKING:
    from bayes_body.results.storage.saved_run import SavedRun


@dataclass(frozen=True, eq=False)
class Inspection:
    """A run that is reported.

    Attributes:
        run: the run, loaded from its folder.
        limits: limits beyond which a figure gives a warning.
        watch: wraps the frames of what takes some seconds, to show progress.
    """

    run: "SavedRun"
    limits: Thresholds = Thresholds()
    watch: Watch = unwatched

    @cached_property
    def diagnosis(self) -> Diagnosis:
        """The run's diagnostic figures in every frame."""
        return diagnose(self.run)

    @cached_property
    def warnings(self) -> list[str]:
        """A sentence for frames in which the body is not on the person, for pairs of frames that mislead, and for each limit that is crossed."""
        return [*fit_sentences(self.run.summary), *self.run.summary.get("frame_pairs", []), *sentences(self.diagnosis, self.limits)]

    def number(self, frame: int) -> int:
        """The number by which the user knows a frame, counted from 0."""
        return self.run.first_frame + frame

    @property
    def runs(self) -> int:
        """Number of independent runs."""
        return self.diagnosis.ess.shape[0]

    @property
    def lost(self) -> Bool[np.ndarray, " frame"]:
        """Frames that at least one run could not explain."""
        return self.diagnosis.lost.any(axis=0)

    @property
    def agreement_known(self) -> bool:
        """Whether any R-hat exists."""
        return bool(np.isfinite(self.diagnosis.rhat).any())

    @cached_property
    def fps(self) -> float | None:
        """Frames a second; None if the session can no longer be read."""
        try:
            return self.run.fps
        except InputError:
            return None

    @property
    def has_truth(self) -> bool:
        """Whether the session names true markers; False if it can no longer be read."""
        try:
            return self.run.session.truth is not None
        except InputError:
            return False

    @cached_property
    def frames(self) -> range:
        """The frames of curves: no more than MOST_POINTS, evenly spaced."""
        return range(0, self.run.frames, frames_a_point(self.run.frames))

    @cached_property
    def curves(self) -> Moments:
        """The dofs at those frames, degrees and metres."""
        return dof_curves(self.run, self.frames)

    @cached_property
    def clinical(self) -> Curves:
        """The clinical angles at those frames; none if the body file names no segments, or if the model can no longer be built."""
        return clinical_curves(self.run, self.frames)

    @cached_property
    def filtered(self) -> FilterCurves | None:
        """The same curves of the filter's run that was smoothed; None if there is none."""
        return filter_curves(self.run, self.frames)

    @cached_property
    def prediction(self) -> Predicted | str:
        """What the draws predict in the images, against what was seen there; a sentence if that cannot be compared."""
        return prediction_of(self.run, self.watch)

    @property
    def x_label(self) -> str:
        """Label of an axis of time whose points are bins of frames."""
        size = frames_a_point(self.run.frames)
        return time_label(self.fps, f"{size} frames per point" if size > 1 else "")

    @cached_property
    def dofs(self) -> tuple[str, ...]:
        """Names of the dofs."""
        return self.diagnosis.dofs

    @cached_property
    def units(self) -> tuple[str, ...]:
        """Unit of each dof, `°` or `m`."""
        return units_of(self.run)
