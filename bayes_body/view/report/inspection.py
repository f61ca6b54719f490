"""Data shared by all parts of the page: the run, its diagnosis and its warnings, each computed on first use.

The frames and dofs that are shown in detail are chosen here, and samples of equal weight are drawn in them. Dofs have readable names and belong to
limbs.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from bayes_body.base.errors import InputError, escaped
from bayes_body.base.progress import Watch, unwatched
from bayes_body.results.clinical.determined import undetermined_angles
from bayes_body.results.clinical.moments import Curves
from bayes_body.results.metrics.plausibility_sentences import fit_sentences
from bayes_body.results.metrics.unknown_sentences import unknown_sentences
from bayes_body.results.posterior.blocks import coordinate_blocks, weights_of_runs
from bayes_body.results.posterior.diagnostics import Diagnosis, Thresholds, diagnose, sentences
from bayes_body.results.posterior.moments import Moments
from bayes_body.results.posterior.resampling import RESAMPLING_SEED
from bayes_body.view.report.curves import FilterCurves, clinical_curves, dof_curves, dof_scale, filter_curves, units_of
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
        """A sentence for each: frames with the body beside the person, pairs of frames that mislead, limits that are crossed, unknowns far off."""
        summary = self.run.summary
        return [*fit_sentences(summary), *summary.get("frame_pairs", []), *sentences(self.diagnosis, self.limits), *unknown_sentences(summary)]

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
    def undetermined(self) -> frozenset[str]:
        """The clinical angles of which the posterior is hardly narrower than the motion prior; none of a mode seeker, whose spread is no measure."""
        names, moments = self.clinical
        if not names or self.diagnosis.mode_seeker:
            return frozenset()
        return undetermined_angles(self.run.model, "xyz".index(self.run.session.up), names, moments.sd)

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


FEWEST_DRAWS, MOST_DRAWS, DOFS = 20, 200, 3


class Sample(NamedTuple):
    """Draws of equal weight at one frame.

    Attributes:
        frame: index of the frame.
        poses: the drawn poses, degrees and metres.
    """

    frame: int
    poses: Float[np.ndarray, "run draw dof"]


def worst_frame(inspection: Inspection) -> int:
    """Return the frame with the largest R-hat; if there is no R-hat, the frame with the fewest effective particles."""
    if inspection.agreement_known:
        return int(np.nan_to_num(inspection.diagnosis.rhat, nan=-np.inf).max(axis=1).argmax())
    return int(inspection.diagnosis.ess.min(axis=0).argmin())


def chosen_frames(inspection: Inspection) -> list[int]:
    """Return the first, the worst and the last frame, without repetition."""
    return sorted({0, worst_frame(inspection), len(inspection.diagnosis.lost[0]) - 1})


def chosen_dofs(inspection: Inspection) -> list[int]:
    """Return the dofs with the largest R-hat in some frame.

    If there is no R-hat, return those with the largest spread in the worst frame, in degrees or metres: angles come before positions.
    """
    if inspection.agreement_known:
        figures_of = np.nan_to_num(inspection.diagnosis.rhat, nan=-np.inf).max(axis=0)
    else:
        figures_of = equal_weight_sample(inspection, worst_frame(inspection)).poses.std(axis=(0, 1))
    ordered = np.argsort(-figures_of, kind="stable")[:DOFS].tolist()
    # A dof that never moves has no R-hat and no spread: there is nothing to plot.
    return [dof for dof in ordered if figures_of[dof] > 0]


def equal_weight_sample(inspection: Inspection, frame: int) -> Sample:
    """Return systematic draws in random order. Their number is the smallest effective sample size of the runs, within FEWEST_DRAWS and MOST_DRAWS."""
    ess = float(np.nanmin(inspection.diagnosis.ess[:, frame]))
    count = round(np.clip(ess, FEWEST_DRAWS, MOST_DRAWS))
    (block,) = coordinate_blocks(inspection.run.tree, range(frame, frame + 1), spaces=inspection.run.spaces)
    rng = np.random.default_rng([RESAMPLING_SEED, frame])
    out = []
    for weights, poses in zip(weights_of_runs(block.log_weights)[..., 0], block.poses[:, :, 0], strict=True):
        levels = (np.arange(count) + rng.random()) / count
        places = np.minimum(np.searchsorted(np.cumsum(weights), levels), len(weights) - 1)
        out.append(poses[rng.permutation(places)])
    return Sample(frame, np.stack(out) * dof_scale(inspection.units))


SIDES = {"l": "left", "r": "right"}
# Words in the names of joints. Joints with other names are grouped under OTHER.
LIMBS = {
    "leg": ("hip", "thigh", "knee", "shank", "calf", "ankle", "foot", "toe"),
    "arm": ("clavicle", "scapula", "shoulder", "upper_arm", "elbow", "forearm", "wrist", "hand"),
    "Trunk and head": ("pelvis", "spine", "lumbar", "torso", "thorax", "chest", "neck", "head"),
    "Position and orientation of the whole body": ("root",),
}
OTHER = "Other joints"


def by_limb(dofs: Sequence[str]) -> Mapping[str, list[int]]:
    """Return the indices of the dofs, grouped by limb. Limbs are in the order in which a reader expects them, dofs in that of the body."""
    groups: dict[str, list[int]] = {}
    for place, dof in enumerate(dofs):
        groups.setdefault(limb(dof), []).append(place)
    order = ("Left leg", "Right leg", "Leg", "Left arm", "Right arm", "Arm", *LIMBS, OTHER)
    return {name: groups[name] for name in order if name in groups}


def limb(dof: str) -> str:
    """Return the limb of a dof, such as `Left leg`."""
    side, joint = _side(dof)
    part = next((name for name, words in LIMBS.items() if any(word in joint for word in words)), OTHER)
    return f"{side} {part}".strip().capitalize() if part in ("leg", "arm") else part


def spoken(dof: str) -> str:
    """Return the readable name of a dof or part: `left hip y` for `l_hip_y`. It is one line, which a plot can show."""
    side, joint = _side(escaped(dof))
    return f"{side} {joint}".strip().replace("_", " ")


def _side(dof: str) -> tuple[str, str]:
    match = re.match(r"([lr])_(.+)", dof)
    return (SIDES[match[1]], match[2]) if match else ("", dof)
