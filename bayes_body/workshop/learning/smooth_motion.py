r"""Learn the noise of smooth motion from captured motion: options of the motion prior `constant_velocity` (Sidenbladh, Black & Fleet 2000, 5).

Each motion is retargeted to a body. With the velocity $v_t = (s_{t+1} - s_{t-1}) / (2 \Delta t)$ of an angle or a position,

$$\sigma = \mathrm{rms}\,(s_t - s_{t-1} - v_{t-1}\,\Delta t), \qquad \sigma_v = \mathrm{rms}\,(v_t - v_{t-1}).$$

Both sides of the body have the same noise. Every person has the same weight.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import input_error
from bayes_body.initial.retarget import retarget
from bayes_body.model.body.build import build_body
from bayes_body.model.body.schema import BodySchema
from bayes_body.recording.readers.mocap import resample
from bayes_body.recording.readers.mocap.motion import Motion
from bayes_body.workshop.learning.walking_angles import FPS, settled_frames

FEWEST = 5


class SmoothNoise(NamedTuple):
    """Standard deviations per frame at FPS, of the pose (rad, m) and of its velocity (rad/s, m/s), by patterns of dofs."""

    pose: Mapping[str, float]
    velocity: Mapping[str, float]
    units: Mapping[str, str]


class Track(NamedTuple):
    """A person, and the dofs of a body that follows a captured motion, radians and metres."""

    subject: str
    dofs: Float[np.ndarray, "frame dof"]


def track_of(subject: str, motion: Motion, body: str, schema: BodySchema) -> Track:
    """Retarget a captured motion to a body, at FPS.

    Raises:
        InputError: the motion lacks points of the body, or is too short.
    """
    start = build_body(body, schema)
    fit = retarget(start, resample(motion, FPS), schema=schema)
    if len(fit.angles) < FEWEST:
        raise input_error(f"a motion of {subject}", f"{len(fit.angles)} frames at {FPS:g} fps", f"{FEWEST} or more", "leave it out")
    return Track(subject, settled_frames(fit.body, fit.angles))


def smooth_noise(tracks: Sequence[Track], body: str, schema: BodySchema) -> SmoothNoise:
    """Return the noise that the tracks have in the mean."""
    topology = build_body(body, schema).skeleton.topology
    people = sorted({track.subject for track in tracks})
    squares = np.mean([np.mean([_squares(t.dofs) for t in tracks if t.subject == person], axis=0) for person in people], axis=0)
    patterns = [f"?_{name[2:]}" if name[:2] in ("l_", "r_") else name for name in topology.dof_names]
    units = dict(zip(patterns, topology.dof_units, strict=True))

    def pooled(mean_squares: Float[np.ndarray, " dof"]) -> dict[str, float]:
        dof_patterns = np.array(patterns)
        return {pattern: float(np.sqrt(mean_squares[dof_patterns == pattern].mean())) for pattern in units}

    return SmoothNoise(pooled(squares[0]), pooled(squares[1]), units)


def _squares(dofs: Float[np.ndarray, "frame dof"]) -> Float[np.ndarray, "2 dof"]:
    """Return the mean squares of the pose's noise and of the velocity's."""
    velocity = (dofs[2:] - dofs[:-2]) * FPS / 2
    residual = dofs[2:-1] - dofs[1:-2] - velocity[:-1] / FPS
    return np.stack([np.mean(residual**2, axis=0), np.mean(np.diff(velocity, axis=0) ** 2, axis=0)])
