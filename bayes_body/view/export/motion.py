"""The exported data of a run: markers, and dofs or parts, in every frame, with standard deviation and 5 % and 95 % quantiles of the posterior.

The particles of a mode seeker are not a sample of the posterior. Of such a run only the means are exported.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from bayes_body.base.errors import InputError
from bayes_body.model.body.placement import ByParts
from bayes_body.model.body.solids import Body
from bayes_body.results.clinical.gait import POINTS, Event, gait_of
from bayes_body.results.clinical.moments import Curves, clinical_angles, opensim_coordinates
from bayes_body.results.clinical.trajectories import marker_paths
from bayes_body.results.posterior.moments import Moments, MomentsAndMedian
from bayes_body.results.storage.saved_moments import angle_moments, marker_moments, mean_configurations
from bayes_body.results.storage.saved_run import SavedRun
from bayes_body.view.export.world import AXES, Axis, Order, order_of, turned_body, turned_dofs, turned_parts

MODE_SEEKER_MOMENTS = ("mean",)
# Frames of a motion in memory: a multiple of the frames that are read at once (`blocks.BLOCK`).
FRAMES_AT_ONCE = 2048
# Fields of `RunMoments` with angles, or none.
type Angles = Literal["clinical", "opensim", "none"]


class Parts(NamedTuple):
    """The parts of a loose-limbed body, each with its own rigid transform.

    Attributes:
        names: names of the parts.
        mean: mean transforms (frame, part, 7), metres and unit quaternions; the sign of a quaternion does not jump from frame to frame.
        origins: (frame, part, 3), metres.
        turns: rotation vectors from the mean quaternion, about the part's own axes (frame, part, 3), degrees; their mean is 0.
    """

    names: tuple[str, ...]
    mean: Float[np.ndarray, "frame part 7"]
    origins: Moments
    turns: Moments


@dataclass(frozen=True)
class Motion:
    """A run's motion, or some frames of it; all its independent filters have the same weight.

    Attributes:
        title: title of the session.
        fps: frames a second.
        up: the axis that points up.
        marker_names: names of the virtual markers.
        markers: (frame, marker, 3), metres.
        dof_names: names of the body's dofs; none if the body is placed by its parts.
        dof_units: unit of each dof, `deg` or `m`.
        dofs: (frame, dof), degrees and metres; they place `body`.
        lost: frames that were lost in at least one run: no particle of it explained them, and their values are predictions. Also frames in which a
            body is off the person (`frames_off` of `summary.json`).
        body: the run's body, in the axes of this motion.
        moments: the fields of `Moments` that are written; only the mean for a mode seeker.
        first_frame: number of the motion's first frame in the recording.
        parts: the parts of a loose-limbed body, in the axes of this motion; None if the body is placed by joint angles.
        clinical: clinical angles, degrees; for OpenSim the coordinates of its models, degrees and metres. Empty for formats that store neither.
        events: gait events of a smoothed run (`RunMoments.events`); empty for formats that store none.
        skipped: number of frames of the motion before these.
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
    moments: tuple[str, ...] = Moments._fields
    first_frame: int = 0
    parts: Parts | None = None
    clinical: Curves = Curves((), Moments(*np.zeros((4, 0, 0))))
    events: tuple[Event, ...] = ()
    skipped: int = 0

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
        """The time of each frame; the motion's first is at 0, whatever its number."""
        return (self.skipped + np.arange(self.frames)) / self.fps

    @property
    def numbers(self) -> Int[np.ndarray, " frame"]:
        """The number of each frame in the recording."""
        return self.first_frame + self.skipped + np.arange(self.frames)

    @property
    def in_memory(self) -> "Motion":
        """The motion itself: it is in memory. (`LongMotion` is not.)"""
        return self

    def blocks(self) -> Iterator["Motion"]:
        """Yield the motion itself: it is in memory. (`LongMotion` yields some frames at a time.)"""
        yield self


class RunMoments:
    """What the formats store of some frames of a run, in the session's axes. Each quantity is computed once, when a format asks for it.

    Args:
        run: the run, loaded from its folder.
        frames: numbers of the frames; all by default.
        previous: the motion of the frames before, in the session's axes and with the angles that are asked for. Turns and quaternions go on from it.
    """

    def __init__(self, run: SavedRun, frames: range | None = None, previous: "Motion | None" = None):
        self.run, self.frames, self.previous = run, range(run.frames) if frames is None else frames, previous

    @cached_property
    def markers(self) -> Moments:
        """Positions of the markers (`marker_moments`)."""
        return marker_moments(self.run, self.frames)

    @cached_property
    def variables(self) -> Moments:
        """Dofs, or coordinates of the parts (`angle_moments`)."""
        return angle_moments(self.run, self.frames)

    @cached_property
    def mean_parts(self) -> Float[np.ndarray, "frame part 7"]:
        """Mean transforms of the parts of a loose-limbed body."""
        return mean_configurations(self.run, self.frames)

    @cached_property
    def clinical(self) -> Curves:
        """Clinical angles (`clinical_angles`)."""
        return clinical_angles(self.run, self.frames, previous=self._last_angles)

    @cached_property
    def opensim(self) -> Curves:
        """Coordinates of OpenSim's models (`opensim_coordinates`)."""
        return opensim_coordinates(self.run, self.frames, previous=self._last_angles)

    @property
    def _last_angles(self) -> Float[np.ndarray, " name"] | None:
        return None if self.previous is None else self.previous.clinical.moments.mean[-1]

    @cached_property
    def events(self) -> tuple[Event, ...]:
        """Gait events; none of a filter's run, of a body without the markers, and of a recording that is too short."""
        if not self.run.smoothed or not set(POINTS) <= set(self.run.model.body.markers.names):
            return ()
        try:
            return gait_of(marker_paths(self.run, POINTS), self.run.fps, AXES.index(self.run.session.up)).events
        except InputError:
            return ()


def read_motion(
    run: SavedRun | RunMoments, fps: float | None = None, up: Axis | None = None, angles: Angles = "clinical", events: bool = False
) -> Motion:
    """Return the motion of a run.

    Args:
        run: the run, loaded from its folder; or its moments, so that several formats share them.
        fps: frames a second, if the session's value is wrong; no frame is added or left out.
        up: the axis that points up in the result; the session's by default. The axes are permuted cyclically (x, y, z to y, z, x): no reflection.
            Markers, parts and the root's positions are turned. An angle of the root keeps its value: its axis is turned.
        angles: clinical angles, OpenSim's coordinates in their place, or none.
        events: whether to look for gait events.

    Raises:
        InputError: a file of the run cannot be used.
    """
    run_moments = run if isinstance(run, RunMoments) else RunMoments(run)
    run = run_moments.run
    order = order_of(run.session.up, up or run.session.up)
    parts = _parts(run_moments, order)
    frames = run_moments.frames
    names, units, dofs = _dofs(run_moments, order) if parts is None else ((), (), Moments(*np.zeros((4, len(frames), 0))))
    rate = run.fps if fps is None else fps
    return Motion(
        title=run.session.title,
        fps=rate,
        up=up or run.session.up,
        marker_names=run.model.body.markers.names,
        markers=Moments(*(values[..., list(order)] for values in run_moments.markers)),
        dof_names=names,
        dof_units=units,
        dofs=dofs,
        lost=lost_frames(run)[frames.start : frames.stop],
        body=turned_body(run.settled_model.body, order),
        moments=MODE_SEEKER_MOMENTS if run.mode_seeker else Moments._fields,
        first_frame=run.first_frame,
        parts=parts,
        clinical=Curves((), Moments(*np.zeros((4, len(frames), 0)))) if angles == "none" else getattr(run_moments, angles),
        # Another rate moves the events as it moves the frames.
        events=tuple(event._replace(times=event.times * (run.fps / rate)) for event in run_moments.events) if events else (),
        skipped=frames.start,
    )


def lost_frames(run: SavedRun) -> Bool[np.ndarray, " frame"]:
    """Return which frames are lost in at least one run, or have a body that is off the person (see `Motion`)."""
    lost = np.asarray(run.tree["filter"]["lost"], bool).any(axis=0)
    off = np.asarray(run.summary.get("frames_off") or [], int) - run.summary.get("first_frame", 0)
    lost[off[(off >= 0) & (off < len(lost))]] = True
    return lost


def _dofs(run_moments: RunMoments, order: Order) -> tuple[tuple[str, ...], tuple[str, ...], Moments]:
    """Return the names, units and moments of the dofs, in other axes."""
    body = run_moments.run.model.body
    angular = np.array(body.skeleton.topology.angular)
    units = tuple("deg" if angle else "m" for angle in angular)
    dofs = Moments(*(np.where(angular, np.degrees(values), values) for values in run_moments.variables))
    return body.dof_names, units, turned_dofs(dofs, body, order)


def _parts(run_moments: RunMoments, order: Order) -> Parts | None:
    """Return the parts of a loose-limbed body, in other axes."""
    placement = run_moments.run.model.body.placement
    if not isinstance(placement, ByParts):
        return None
    coordinates = [values.reshape(len(run_moments.frames), len(placement.names), 6) for values in run_moments.variables]
    origins = Moments(*(values[..., list(order)] for values in coordinates))
    # Rotation vectors are about the part's own axes, which do not change with those of the world.
    turns = Moments(*(np.degrees(values[..., 3:]) for values in coordinates))
    turned, previous = turned_parts(run_moments.mean_parts, order), None if run_moments.previous is None else run_moments.previous.parts
    path = turned if previous is None else np.concatenate([previous.mean[-1:], turned])
    return Parts(placement.names, _continued(path)[len(path) - len(turned) :], origins, turns)


def _continued(parts: Float[np.ndarray, "frame part 7"]) -> Float[np.ndarray, "frame part 7"]:
    """Return the transforms with each quaternion of the sign that is nearer to the frame before."""
    q = parts[..., 3:]
    signs = np.where(np.sum(q[1:] * q[:-1], axis=-1) < 0, -1.0, 1.0).cumprod(axis=0)
    return np.concatenate([parts[..., :3], q * np.concatenate([np.ones_like(q[:1, :, 0]), signs])[..., None]], axis=-1)


class LongMotion:
    """The motion of a whole run, of which some frames at a time are in memory. `run`, `fps`, `up`, `angles` and `events` are those of `read_motion`.

    Args:
        moments: the moments of the whole run. A run of at most FRAMES_AT_ONCE frames takes its motion from them, so that formats share it.
    """

    def __init__(self, moments: RunMoments, fps: float | None, up: Axis | None, angles: Angles, events: bool):
        self._angles: Angles = angles
        self._moments, self._with_events = moments, events
        self.run = run = moments.run
        self.up: Axis = up or run.session.up
        self.frames, self.fps = run.frames, run.fps if fps is None else fps
        self.marker_names, self.first_frame, self.lost = run.model.body.markers.names, run.first_frame, lost_frames(run)
        self.moments = MODE_SEEKER_MOMENTS if run.mode_seeker else Moments._fields

    @property
    def has_intervals(self) -> bool:
        """Whether standard deviations and quantiles are written."""
        return self.moments != MODE_SEEKER_MOMENTS

    @cached_property
    def events(self) -> tuple[Event, ...]:
        """As in `Motion`."""
        # Another rate moves the events as it moves the frames.
        return tuple(event._replace(times=event.times * (self.run.fps / self.fps)) for event in self._moments.events) if self._with_events else ()

    def blocks(self) -> Iterator[Motion]:
        """Yield the motion in blocks of frames.

        Raises:
            InputError: a file of the run cannot be used.
        """
        if self.frames <= FRAMES_AT_ONCE:
            yield self._read(self._moments)
            return
        previous = None
        for start in range(0, self.frames, FRAMES_AT_ONCE):
            frames = range(start, min(start + FRAMES_AT_ONCE, self.frames))
            previous = self._read(RunMoments(self.run, frames, previous))
            yield previous

    def _read(self, moments: RunMoments) -> Motion:
        return read_motion(moments, self.fps, self.up, self._angles)

    @cached_property
    def in_memory(self) -> Motion:
        """The motion of all frames, in memory.

        Raises:
            InputError: a file of the run cannot be used.
        """
        blocks = list(self.blocks())
        curves = blocks[0].clinical
        parts = [block.parts for block in blocks if block.parts is not None]
        return replace(
            blocks[0],
            markers=_joined([block.markers for block in blocks]),
            dofs=_joined([block.dofs for block in blocks]),
            clinical=Curves(curves.names, _joined([block.clinical.moments for block in blocks])),
            parts=Parts(
                parts[0].names,
                np.concatenate([part.mean for part in parts]),
                _joined([part.origins for part in parts]),
                _joined([part.turns for part in parts]),
            )
            if parts
            else None,
            lost=self.lost,
            events=self.events,
        )


def _joined[M: Moments | MomentsAndMedian](pieces: Sequence[M]) -> M:
    return type(pieces[0])(*(np.concatenate(parts) for parts in zip(*pieces, strict=True)))
