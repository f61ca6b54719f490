r"""Smooth motion with its velocity in the state (Sidenbladh, Black & Fleet 2000, 5): pose and velocity are two sampled variables,

$$s_t \sim \mathcal N(s_{t-1} + v_{t-1}\,\Delta t,\ \sigma^2)\ \text{truncated to}\ [\mathrm{low}, \mathrm{high}], \qquad
v_t \sim \mathcal N(v_{t-1},\ \sigma_v^2).$$

The truncated normal is normalised given the previous state. A prediction beyond a limit counts as the limit: otherwise a fast movement into a limit
would leave no mass inside. At the first pose the velocity is 0. In `second_order` the velocity is the last change of the pose, which is noisier.
"""

import math
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array
from numpyro.distributions import Distribution, Normal

from bayes_body.body.placement import POSE, require
from bayes_body.body.solids import Body
from bayes_body.body.space import pose_space
from bayes_body.density.factor import State, Transition
from bayes_body.density.spaces import euclidean
from bayes_body.dynamics.deviations import standard_deviations
from bayes_body.dynamics.diffusion import TruncatedWalk
from bayes_body.registry import register
from bayes_body.shapes import Pose, Scalar
from bayes_body.toml.schema import Positive, Schema

VELOCITY = "velocity"

type Arguments = tuple[Scalar, Pose, Pose, Pose, Pose]


class Options(Schema):
    """Options of `[dynamics] kind = "constant_velocity"`: standard deviations of every dof per frame at `at_fps`.

    `sd_deg` and `sd_m` are those of the pose, `velocity_sd_deg` and `velocity_sd_m` those of the velocity's change, in degrees and metres per second.
    Keys are names of dofs or patterns. All grow with the square root of the time between frames.
    """

    sd_deg: Mapping[str, Positive] = {}
    sd_m: Mapping[str, Positive] = {}
    velocity_sd_deg: Mapping[str, Positive] = {}
    velocity_sd_m: Mapping[str, Positive] = {}
    at_fps: Positive = 60.0


def _conditional(arguments: Arguments, previous: State) -> dict[str, Distribution]:
    step_s, sd, velocity_sd, low, high = arguments
    predicted = jnp.clip(previous[POSE] + step_s * previous[VELOCITY], low, high)
    return {POSE: TruncatedWalk(predicted, sd, low, high), VELOCITY: _normal(previous[VELOCITY], velocity_sd)}


def _perturbation(arguments: Arguments, state: State, scale: Scalar) -> dict[str, Distribution]:
    _, sd, velocity_sd, low, high = arguments
    return {POSE: TruncatedWalk(state[POSE], sd * scale, low, high), VELOCITY: _normal(state[VELOCITY], velocity_sd * scale)}


def _normal(centre: Array, sd: Array) -> Distribution:
    return Normal(centre, sd).to_event(1)


def _begin(first: State) -> dict[str, Array]:
    return {POSE: first[POSE], VELOCITY: jnp.zeros_like(first[POSE])}


@register("dynamics", "constant_velocity", Options)
def build(options: Options, body: Body, fps: float, **_: Any) -> Transition:
    """Build the process for one body and frame rate. It ignores the session's standard deviations of changes between frames, which are not its noise.

    Raises:
        InputError: the body is placed by parts, a dof has no standard deviation, or a key of the options matches no dof.
    """
    require(body, POSE, "dynamics 'constant_velocity'", 'kind = "rigid_walk"')
    topology, dtype, walked = body.skeleton.topology, body.lengths.dtype, math.sqrt(options.at_fps / fps)
    tables = ((options.sd_deg, options.sd_m, ""), (options.velocity_sd_deg, options.velocity_sd_m, "velocity_"))
    by_name = [standard_deviations(degrees, metres, topology, prefix) for degrees, metres, prefix in tables]
    sd, velocity_sd = (jnp.asarray([each[name] * walked for name in topology.dof_names], dtype) for each in by_name)
    arguments = (jnp.asarray(1 / fps, dtype), sd, velocity_sd, body.skeleton.low, body.skeleton.high)
    names, units = tuple(f"{name}_velocity" for name in topology.dof_names), tuple(f"{unit}/s" for unit in topology.dof_units)
    return Transition(
        "constant_velocity",
        jax.tree_util.Partial(_conditional, arguments),
        jax.tree_util.Partial(_perturbation, arguments),
        begin=jax.tree_util.Partial(_begin),
        spaces=((POSE, pose_space(body)), (VELOCITY, euclidean(names, units, "velocity_dof"))),
    )
