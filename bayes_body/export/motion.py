"""The exported data of a run: markers and dofs in every frame, with standard deviation and 5 % and 95 % quantiles of the posterior.

The particles of a mode seeker are not a sample of the posterior. Of such a run only the means are exported.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from bayes_body.body.solids import Body
from bayes_body.posterior.moments import Moments
from bayes_body.storage.saved_moments import angle_moments, marker_moments
from bayes_body.storage.saved_run import SavedRun

type Axis = Literal["x", "y", "z"]
AXES: tuple[Axis, ...] = ("x", "y", "z")
MODE_SEEKER_MOMENTS = ("mean",)


@dataclass(frozen=True)
class Motion:
    """A run's motion; all its independent filters have the same weight.

    Attributes:
        title: title of the session.
        fps: frames a second.
        up: the axis that points up.
        marker_names: names of the virtual markers.
        markers: (frame, marker, 3), metres.
        dof_names: names of the body's dofs.
        dof_units: unit of each dof, `deg` or `m`.
        dofs: (frame, dof), degrees and metres.
        lost: frames that were lost in at least one run: no particle of it explained them, and their values are predictions.
        body: the run's body, to compute joints from the dofs.
        order: the session's axes that are x, y and z here.
        moments: the fields of `Moments` that are written; only the mean for a mode seeker.
    """

    title: str
    fps: float
    up: Axis
    marker_names: tuple[str, ...]
    markers: Moments
    dof_names: tuple[str, ...]
    dof_units: tuple[str, ...]
    dofs: Moments
    lost: Bool[np.ndarray, " frame"]
    body: Body
    order: tuple[int, int, int]
    moments: tuple[str, ...] = Moments._fields

    @property
    def has_intervals(self) -> bool:
        """Whether standard deviations and quantiles are written."""
        return self.moments != MODE_SEEKER_MOMENTS

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.lost)

    @property
    def seconds(self) -> Float[np.ndarray, " frame"]:
        """The time of each frame; the first is at 0."""
        return np.arange(self.frames) / self.fps


def read_motion(run: SavedRun, fps: float | None = None, up: Axis | None = None) -> Motion:
    """Return the motion of a run.

    Args:
        run: the run, loaded from its folder.
        fps: frames a second, if the session's value is wrong; no frame is added or left out.
        up: the axis that points up in the result; the session's by default. The axes are permuted cyclically (x, y, z to y, z, x): no reflection.

    Raises:
        InputError: a file of the run cannot be used.
    """
    angular = np.array(run.model.body.skeleton.topology.angular)
    dofs = Moments(*(np.where(angular, np.degrees(values), values) for values in angle_moments(run)))
    order = _order(run.session.up, up or run.session.up)
    return Motion(
        title=run.session.title,
        fps=run.fps if fps is None else fps,
        up=up or run.session.up,
        marker_names=run.model.body.markers.names,
        markers=Moments(*(values[..., list(order)] for values in marker_moments(run))),
        dof_names=run.model.body.dof_names,
        dof_units=tuple("deg" if angle else "m" for angle in angular),
        dofs=dofs,
        lost=np.asarray(run.tree["filter"]["lost"], bool).any(axis=0),
        body=run.model.body,
        order=order,
        moments=MODE_SEEKER_MOMENTS if run.mode_seeker else Moments._fields,
    )


def _order(given: Axis, wanted: Axis) -> tuple[int, int, int]:
    """Return the given axes that become x, y and z. It is a cyclic permutation, so standard deviations and quantiles still belong to single axes."""
    turn = AXES.index(given) - AXES.index(wanted)
    return turn % 3, (1 + turn) % 3, (2 + turn) % 3
