"""Filters over the frames of a fit, and how far the body's joints are from the keypoints."""

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from bayes_body.base.geometry.camera import Camera, project
from bayes_body.base.shapes import Key
from bayes_body.density.kernel import Kernel
from bayes_body.initial import Show, apply_first_pose, first_pose, with_first_keypoints
from bayes_body.model.build import Model, build_model
from bayes_body.model.definition import Definition
from bayes_body.recording.readers.excerpt import excerpt
from bayes_body.recording.session.session import Session
from bayes_body.results.posterior import markers, mean_pose
from bayes_body.runs.unknowns.frames import Stretch, keypoints_of
from bayes_body.tracking.draws import Draws
from bayes_body.tracking.observations import observations
from bayes_body.tracking.track import track


def stretch_of(session: Session, stretch: Stretch) -> Session:
    """Return the session of a stretch, with all frames between its first and its last one."""
    return excerpt(session, session.frame_number(stretch.first), stretch.span)


def models(definitions: list[Definition], session: Session, stretch: Stretch, show: Show) -> list[Model]:
    """Return the models of definitions that share a body, at the rate of a stretch's frames, with one first pose: that of its first frame.

    Args:
        definitions: the first one is that with which the pose is fitted.
        session: from `stretch_of`.
        stretch: the frames.
        show: receives lines about the fit.

    Raises:
        InputError: a model cannot be built, or no first pose is found.
    """
    slow = replace(session, fps=session.fps / stretch.step, fit_lengths=False, fit_outline=False)
    built = [build_model(definition, slow) for definition in definitions]
    slow = with_first_keypoints(built[0], slow)
    estimate = first_pose(built[0], slow, show=show)
    return [apply_first_pose(model, slow, estimate) for model in built]


def filtered(
    key: Key, session: Session, model: Model, stretch: Stretch, runs: int, kernel: Kernel | None = None, on_frame: Callable[[int], None] | None = None
) -> Draws:
    """Filter the frames of a stretch.

    Args:
        key: random key.
        session: from `stretch_of`.
        model: from `models`.
        stretch: the frames.
        runs: number of independent filters.
        kernel: the model's by default.
        on_frame: called after each frame with the number of frames done.

    Raises:
        InputError: a frame cannot be read.
    """
    arriving = observations(session, model, stretch.indices)
    return track(key, session, model, kernel, None, runs, stretch.frames, lambda p: on_frame(p.frame) if on_frame else None, arriving=arriving)


def distances_px(session: Session, drawn: Draws, stretch: Stretch) -> list[float]:
    """Return the median distance of the joints of the mean poses from the keypoints in each camera, pixels; NaN for a camera without keypoints.

    Args:
        session: from `stretch_of`.
        drawn: its filter, without unknowns.
        stretch: the frames.
    """
    model = drawn.model
    keypoints = keypoints_of(session, model.body.markers.names)[list(stretch.indices)]
    poses = np.stack([mean_pose(frame, model)[0] for frame in drawn.frames])
    pixels, in_front = (np.asarray(out) for out in _projected(model.rig, jnp.asarray(markers(model, poses))))
    distances = np.where(in_front, np.linalg.norm(pixels - keypoints, axis=-1), np.inf)
    distances = np.where(np.isfinite(keypoints[..., 0]), distances, np.nan)
    has_keypoints = np.isfinite(keypoints[..., 0]).any(axis=(0, 2))
    return [float(np.nanmedian(distances[:, camera])) if has_keypoints[camera] else float("nan") for camera in range(len(has_keypoints))]


@jax.jit
def _projected(
    rig: Camera, places: Float[Array, "frame marker 3"]
) -> tuple[Float[Array, "frame camera marker 2"], Bool[Array, "frame camera marker"]]:
    return jax.vmap(lambda marker_places: jax.vmap(lambda camera: project(camera, marker_places))(rig))(places)
