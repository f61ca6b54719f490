"""Filters over the frames of a fit, and how far the keypoints are from where a model expects them.

All filters have one compiled program. It is compiled while the first pose is fitted. A filter that takes the session's word has the same unknowns
with standard deviations that are almost 0.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Bool, Float

from bayes_body.base.geometry.camera import Camera, project
from bayes_body.base.geometry.namespaces import device_array
from bayes_body.base.shapes import Key, Pose
from bayes_body.density.factor import variables
from bayes_body.density.kernel import NamedKernel
from bayes_body.density.spaces import euclidean
from bayes_body.initial import FirstPose, Show, apply_first_pose, first_pose, with_first_keypoints
from bayes_body.model.body.placed_body import placed_markers
from bayes_body.model.body.solids import Body
from bayes_body.model.build import Model, build_model
from bayes_body.model.definition import Definition
from bayes_body.model.unknowns.apply import Unknowns, with_changes
from bayes_body.model.unknowns.delays import VELOCITY
from bayes_body.model.unknowns.unknown import Unknown
from bayes_body.recording.readers.excerpt import excerpt
from bayes_body.recording.session.session import Session
from bayes_body.results.posterior import mean_pose
from bayes_body.results.posterior.thinning import weighted_mean
from bayes_body.runs.unknowns.definition import DELAYS, kernel_of
from bayes_body.runs.unknowns.frames import Stretch
from bayes_body.tracking.draws import Draws
from bayes_body.tracking.observations import observations
from bayes_body.tracking.program import Ahead, compiled_ahead
from bayes_body.tracking.track import track

# Share of the unknowns' standard deviations that is left where the session's word is taken.
HELD = 0.02


@dataclass(frozen=True)
class Filter:
    """What filters the frames of a stretch, in several runs.

    Attributes:
        definition: the model with unknowns.
        stretch: the frames.
        runs: number of independent filters.
        kernel: the kernel of all filters. A program belongs to it.
        program: the compiled program of a frame.
        estimate: the first pose.
    """

    definition: Definition
    stretch: Stretch
    runs: int
    kernel: NamedKernel
    program: Ahead
    estimate: FirstPose

    def model(self, part: Session) -> Model:
        """Return the model at the rate of the stretch's frames, from the first pose on. `part` is from `stretch_of`."""
        slow = _slow(part, self.stretch)
        return apply_first_pose(build_model(self.definition, slow), slow, self.estimate)

    def draws(self, key: Key, part: Session, model: Model, on_frame: Callable[[int], None]) -> Draws:
        """Filter the frames.

        Args:
            key: random key.
            part: from `stretch_of`.
            model: from `model`, perhaps with `hold_unknowns`.
            on_frame: called after each frame with the number of frames done.

        Raises:
            InputError: a frame cannot be read.
        """
        arriving, frames = observations(part, model, self.stretch.indices), self.stretch.frames
        return track(
            key, part, model, self.kernel, None, self.runs, frames, lambda progress: on_frame(progress.frame), ahead=self.program, arriving=arriving
        )


def prepare_filter(definition: Definition, part: Session, stretch: Stretch, runs: int, show: Show) -> Filter:
    """Fit the first pose to the first frame of a stretch, and compile the filters' program meanwhile.

    Args:
        definition: the model with unknowns.
        part: from `stretch_of`.
        stretch: the frames.
        runs: number of independent filters.
        show: receives lines about the pose.

    Raises:
        InputError: the model cannot be built, or no first pose is found.
    """
    slow = _slow(part, stretch)
    model = build_model(definition, slow)
    slow, kernel = with_first_keypoints(model, slow), kernel_of(model)
    options: Any = kernel.options
    with compiled_ahead(slow, model, kernel, options.particles, runs) as program:
        estimate = first_pose(model, slow, show=show)
    return Filter(definition, stretch, runs, kernel, program, estimate)


def _slow(part: Session, stretch: Stretch) -> Session:
    return replace(part, fps=part.fps / stretch.step, fit_lengths=False, fit_outline=False)


def stretch_of(session: Session, stretch: Stretch) -> Session:
    """Return the session of a stretch, with all frames between its first and its last one."""
    return excerpt(session, session.frame_number(stretch.first), stretch.span)


def hold_unknowns(model: Model) -> Model:
    """Return the model with its unknowns held at their means."""

    def narrowed(node: object) -> object:
        return replace(node, sd=device_array(HELD * np.asarray(node.sd), node.sd.dtype)) if isinstance(node, Unknown) else node

    names = ("transition", "after_found", "factors", "first", "unknowns")
    parts = [getattr(model, name) for name in names]
    narrow = jax.tree.map(narrowed, parts, is_leaf=lambda node: isinstance(node, Unknown))
    return replace(model, **dict(zip(names, narrow, strict=True)))


def expected_px(part: Session, draws: Draws) -> Float[np.ndarray, "frame camera marker 2"]:
    """Return where the mean poses of the first run put the keypoints, pixels; NaN behind a camera. Offsets and delays count at their means.

    Args:
        part: from `stretch_of`.
        draws: of a model with `hold_unknowns`.
    """
    model, dtype = draws.model, draws.model.body.lengths.dtype
    poses, velocities = (np.stack(values)[None] for values in (_poses(draws), _velocities(draws)))
    moved_poses = poses + np.array(_delays(model, len(part.views)))[:, None, None] * velocities
    pixels, in_front = (np.asarray(out) for out in _projected(model.body, model.rig, model.unknowns, device_array(moved_poses, dtype)))
    return np.swapaxes(np.where(in_front[..., None], pixels, np.nan), 0, 1)


def median_distances(expected: Float[np.ndarray, "frame camera marker 2"], keypoints: Float[np.ndarray, "frame camera marker 2"]) -> list[float]:
    """Return the median distance of the keypoints in each camera from where they are expected; NaN for a camera without keypoints."""
    off, is_visible = np.linalg.norm(expected - keypoints, axis=-1), np.isfinite(keypoints[..., 0])
    off = np.where(np.isnan(off), np.inf, off)
    return [
        float(np.median(off[:, camera][is_visible[:, camera]])) if is_visible[:, camera].any() else float("nan")
        for camera in range(is_visible.shape[1])
    ]


def _delays(model: Model, cameras: int) -> list[float]:
    delays_s = next((np.asarray(term.mean, float).tolist() for term in model.unknowns if term.name == DELAYS), [0.0] * (cameras - 1))
    return [0.0, *delays_s]


def _poses(draws: Draws) -> list[Float[np.ndarray, " dof"]]:
    return [mean_pose(frame, draws.model)[0] for frame in draws.frames]


def _velocities(draws: Draws) -> list[Float[np.ndarray, " dof"]]:
    """Return the mean velocities of the frames; 0 for a model that has none, which has no delays."""
    size = len(draws.model.body.dof_names)
    if VELOCITY not in draws.frames[0].states:
        return [np.zeros(size)] * len(draws.frames)
    space = euclidean(tuple(map(str, range(size))), ("",) * size, "dof")
    return [weighted_mean(frame, VELOCITY, space)[0] for frame in draws.frames]


@jax.jit
def _projected(
    body: Body, rig: Camera, unknowns: Unknowns, poses: Float[Array, "camera frame dof"]
) -> tuple[Float[Array, "camera frame marker 2"], Bool[Array, "camera frame marker"]]:
    """Return where cameras see the markers, with all unknowns at their means. One program: as many small ones would take seconds to compile."""
    means = variables({term.name: term.mean for term in unknowns})
    changed_body = with_changes(tuple(term for term in unknowns if term.node is Body), body, means)
    changed_rig = with_changes(tuple(term for term in unknowns if term.node is Camera), rig, means)

    def of_frame(camera: Camera, pose: Pose) -> tuple[Array, Array]:
        return project(camera, placed_markers(changed_body, pose))

    return jax.vmap(lambda camera, camera_poses: jax.vmap(lambda pose: of_frame(camera, pose))(camera_poses))(changed_rig, poses)
