r"""Smooth motion with soft joint limits (Poon & Fleet 2002, 3.3): a second-order Markov process,

$$s_t \sim \mathrm{noise}\big(\alpha_1 s_{t-1} - \alpha_2 s_{t-2}\big)
  = \mathrm{noise}\big((\alpha_1 - \alpha_2)\, s_{t-1} + \alpha_2 (s_{t-1} - s_{t-2})\big),$$

with the noise of `joint_noise`: Beta with a fixed variance for a dof with limits, normal for the position, wrapped normal for the torso's rotation,
whose velocity is the shorter way round. The previous pose is carried along and is not random. At the first pose the velocity is 0.
"""

import math
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool
from numpyro.distributions import Distribution
from pydantic import model_validator

from bayes_body.base.errors import input_error
from bayes_body.base.registry import register
from bayes_body.base.shapes import Pose, Scalar
from bayes_body.base.toml.schema import Positive, Schema, Share
from bayes_body.density.factor import State, Transition
from bayes_body.model.body.placed_body import require
from bayes_body.model.body.placement import POSE
from bayes_body.model.body.solids import Body, pose_space
from bayes_body.model.dynamics.diffusion import standard_deviations
from bayes_body.model.dynamics.joint_noise import JointNoise

# The key of the previous frame's pose in a state.
BEFORE = "pose_before"
# Largest standard deviation of a freely turning dof, rad: with a larger one, more than the nearest turns would matter.
LARGEST_TURN = math.pi / 2


class Options(Schema):
    """Options of `[dynamics] kind = "second_order"`.

    `alpha_2` is the fraction of the velocity that is kept from frame to frame, `alpha_1 - alpha_2` that of the position. Both, and the noise's
    standard deviations, are valid at `at_fps` frames per second. At another rate, velocities decay at the same rate in seconds, and the prior drifts
    as far.
    """

    alpha_1: Positive = 1.8
    """weight of the last pose. `alpha_1` − `alpha_2` is the fraction of the position that is kept. Keep this difference at 1: if it is smaller, every
    dof drifts towards 0."""
    alpha_2: Share = 0.8
    """fraction of the velocity that is kept from frame to frame."""
    sd_deg: Mapping[str, Positive] = {}
    """[degrees per frame] table: a dof's name or a pattern = the noise's standard deviation; for a dof with limits, it must be less than their range
    / √12."""
    sd_m: Mapping[str, Positive] = {}
    """[metres per frame] the same for translations."""
    at_fps: Positive = 60.0
    """[1/s] frame rate to which these values apply; at another frame rate they are converted, so that velocities decay equally fast in seconds, and a
    body without images drifts equally far."""

    @model_validator(mode="after")
    def _check_position(self) -> "Options":
        if not 0 < self.alpha_1 - self.alpha_2 <= 1:
            problem = f"alpha_1 = {self.alpha_1:g} and alpha_2 = {self.alpha_2:g} keep {self.alpha_1 - self.alpha_2:g} of the position"
            raise ValueError(f"{problem}; expected a fraction above 0 and up to 1; set alpha_1 = 1 + alpha_2")
        return self


def _prediction(position: Scalar, velocity: Scalar, turns: Bool[Array, " dof"], previous: State) -> Pose:
    moved = previous["pose"] - previous[BEFORE]
    shorter = moved - 2 * math.pi * jnp.round(moved / (2 * math.pi))
    return position * previous["pose"] + velocity * jnp.where(turns, shorter, moved)


type Arguments = tuple[Scalar, Scalar, Pose, Pose, Pose, Bool[Array, " dof"]]


def _conditional(arguments: Arguments, previous: State) -> dict[str, Distribution]:
    position, velocity, sd, low, high, angular = arguments
    mode = _prediction(position, velocity, angular & ~jnp.isfinite(low), previous)
    return {"pose": JointNoise(mode, sd, low, high, angular)}


def _perturbation(arguments: Arguments, state: State, scale: Scalar) -> dict[str, Distribution]:
    _, _, sd, low, high, angular = arguments
    return {"pose": JointNoise(state["pose"], sd * scale, low, high, angular)}


def _carry(previous: State, sampled: State) -> dict[str, Array]:
    return {"pose": sampled["pose"], BEFORE: previous["pose"]}


def _begin(first: State) -> dict[str, Array]:
    return {"pose": first["pose"], BEFORE: first["pose"]}


@register("dynamics", "second_order", Options)
def build(options: Options, body: Body, fps: float, **_: Any) -> Transition:
    """Build the process for one body and frame rate. It ignores the session's standard deviations of changes between frames, which are not its noise.

    Raises:
        InputError: a dof has no standard deviation or too large a one, or a key of the options matches no dof.
    """
    require(body, POSE, "dynamics 'second_order'", 'kind = "rigid_walk"')
    topology, skeleton = body.skeleton.topology, body.skeleton
    time = options.at_fps / fps
    position, velocity = (options.alpha_1 - options.alpha_2) ** time, options.alpha_2**time
    by_name = standard_deviations(options.sd_deg, options.sd_m, topology)
    sd = np.array([by_name[name] for name in topology.dof_names]) * _noise_factor(options.alpha_2, velocity, time)
    _check_sizes(body, sd)
    dtype = body.lengths.dtype
    arguments = (
        jnp.asarray(position, dtype),
        jnp.asarray(velocity, dtype),
        jnp.asarray(sd, dtype),
        skeleton.low,
        skeleton.high,
        jnp.asarray(topology.angular),
    )
    return Transition(
        "second_order",
        jax.tree_util.Partial(_conditional, arguments),
        jax.tree_util.Partial(_perturbation, arguments),
        jax.tree_util.Partial(_carry),
        jax.tree_util.Partial(_begin),
        spaces=((POSE, pose_space(body)), (BEFORE, pose_space(body))),
        memory=2,
    )


def _noise_factor(velocity: float, at_rate: float, time: float) -> float:
    """The factor of the noise at another frame rate. It keeps the variance of the distance drifted in a second, σ² fps / (1 − α2)²."""
    faded = time if velocity == 1 else (1 - at_rate) / (1 - velocity)
    return faded * math.sqrt(time)


def _check_sizes(body: Body, sd: np.ndarray) -> None:
    """Check that Beta distributions have a mode: their variance must be below that of the uniform distribution."""
    topology = body.skeleton.topology
    low, high = np.asarray(body.skeleton.low, float), np.asarray(body.skeleton.high, float)
    for index, (name, angular) in enumerate(zip(topology.dof_names, topology.angular, strict=True)):
        unit, number = ("deg", math.degrees(1)) if angular else ("m", 1.0)
        limited = math.isfinite(low[index])
        most = (high[index] - low[index]) / math.sqrt(12) if limited else LARGEST_TURN if angular else math.inf
        if not sd[index] < most:
            why = f"the range of {(high[index] - low[index]) * number:.4g} {unit} over √12" if limited else "a quarter turn"
            problem = f"a standard deviation of {sd[index] * number:.4g} {unit} per frame for '{name}'"
            raise input_error(f"dynamics.sd_{unit}", problem, f"less than {most * number:.4g} {unit}, {why}", "give a smaller value, or wider limits")
