"""Which clinical angles the images determine: those of which the posterior is narrower than the motion prior in the long run.

A motion prior may hold an angle near its value at rest with a standard deviation (`spread_deg`). Where no image shows the angle, this is what the
posterior repeats: of an ankle without keypoints of the foot, say. Such a figure is no measurement.
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bayes_body.model.body.placement import POSE
from bayes_body.model.build import Model
from bayes_body.model.dynamics.diffusion import by_dof
from bayes_body.results.clinical.joints import CHANGE, TRIALS, Joint, joint_frames, joints_of
from bayes_body.results.clinical.moments import laboratory_of
from bayes_body.results.metrics.unknown_sentences import UNDETERMINED

DRAWS = 1000


def undetermined_angles(model: Model, up: int, names: Sequence[str], sd_deg: Float[np.ndarray, "frame angle"]) -> frozenset[str]:
    """Return the names of the angles that are about as uncertain as the motion prior leaves them in the long run.

    Args:
        model: the model of the run.
        up: index of the session's axis that points up.
        names: names of angles, such as `ankle_dorsiflexion_r`.
        sd_deg: their standard deviations in the posterior, degrees.
    """
    prior_deg = prior_sd_deg(model, up)
    rms_deg = np.sqrt(np.mean(np.asarray(sd_deg, float) ** 2, axis=0))
    return frozenset(name for name, sd in zip(names, rms_deg, strict=True) if sd > UNDETERMINED * prior_deg.get(name, np.inf))


def prior_sd_deg(model: Model, up: int) -> dict[str, float]:
    """Return the standard deviation of each clinical angle in the motion prior in the long run, degrees; infinite where it leaves the angle free.

    Args:
        model: the model of a run.
        up: index of the session's axis that points up.
    """
    body, options = model.body, model.definition.dynamics.options
    table = getattr(options, "spread_deg", None)
    joints = joints_of(body, model.definition.body.clinical, laboratory_of(up))
    if not table or not joints or body.variable != POSE:
        return {}
    topology, rng = body.skeleton.topology, np.random.default_rng(0)
    angles = tuple(name for name, is_angle in zip(topology.dof_names, topology.angular, strict=True) if is_angle)
    spread, resting = by_dof(table, angles, "dynamics.spread_deg"), by_dof(options.rest_deg, angles, "dynamics.rest_deg")
    sd, mean = (np.radians([values.get(name, 0.0) for name in topology.dof_names]) for values in (spread, resting))
    low, high = np.asarray(body.skeleton.low, float), np.asarray(body.skeleton.high, float)
    # An angle that a free dof changes is free.
    free_turns = [0.0 if name in spread else 1.0 for name in topology.dof_names] * rng.uniform(-1.0, 1.0, (TRIALS, len(sd)))
    is_free = np.ptp(_angles(model, joints, np.clip(mean + free_turns, low, high)), axis=0) > CHANGE
    drawn = _angles(model, joints, np.clip(mean + sd * rng.normal(size=(DRAWS, len(sd))), low, high))
    angle_sd = np.where(is_free, np.inf, np.degrees(drawn.std(axis=0)))
    return dict(zip([name for joint in joints for name in joint.names], angle_sd.tolist(), strict=True))


def _angles(model: Model, joints: Sequence[Joint], poses: Float[np.ndarray, "draw dof"]) -> Float[np.ndarray, "draw angle"]:
    rotations = np.asarray(joint_frames(model.body, jnp.asarray(poses, model.body.lengths.dtype)).rotation, float)
    return np.concatenate([joint.angles(rotations) for joint in joints], axis=-1)
