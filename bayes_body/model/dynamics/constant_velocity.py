r"""Smooth motion with its velocity in the state (Sidenbladh, Black & Fleet 2000, 5): pose and velocity are two sampled variables,

$$s_t \sim \mathcal N(m_t,\ \sigma^2)\ \text{truncated to}\ [\mathrm{low}, \mathrm{high}], \qquad
v_t \sim \mathcal N\big((m_t - s_{t-1}) / \Delta t,\ \sigma_v^2\big), \qquad
m_t = \operatorname{clip}(s_{t-1} + v_{t-1}\,\Delta t,\ \mathrm{low},\ \mathrm{high}).$$

The truncated normal is normalised given the previous state. A prediction beyond a limit counts as the limit: otherwise a fast movement into a limit
would leave no mass inside. The limit stops the movement: the velocity that goes on is the one with which the limit was reached. Otherwise it would
hold the pose at the limit for as long as it lasts, with hardly any spread. At the first pose the velocity is 0. In `second_order` the velocity is the
last change of the pose, which is noisier.

With a time $\tau$ that a velocity lasts, it is an Ornstein-Uhlenbeck process (Johnson, London, Lea & Durban 2008, for tracks of animals). It is
multiplied by $\phi = e^{-\Delta t / \tau}$ from frame to frame, so that a dof that no image sees does not run away. The first velocity is drawn from
its stationary distribution,

$$v_t \sim \mathcal N\big(\phi\, (m_t - s_{t-1}) / \Delta t - \omega^2 (s_{t-1} - \bar s)\,\Delta t,\ \sigma_v^2\big), \qquad
v_0 \sim \mathcal N(0,\ \sigma_0^2), \quad \sigma_0^2 = \sigma_v^2 / (1 - \phi^2).$$

With a spread S as well, the velocity turns back to a pose at rest, with $\omega = \sigma_0 / S$: a damped oscillator, whose pose has about the
standard deviation S in the long run. It decides between poses that the images do not tell apart, such as a pelvis that leans and a spine that bends.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpyro.distributions import Distribution, Normal

from bayes_body.base.errors import input_error
from bayes_body.base.geometry.namespaces import device_array
from bayes_body.base.registry import register
from bayes_body.base.shapes import Pose, Scalar
from bayes_body.base.toml.schema import Positive, Schema
from bayes_body.density.factor import State, Transition
from bayes_body.density.spaces import euclidean
from bayes_body.model.body.placed_body import require
from bayes_body.model.body.placement import POSE
from bayes_body.model.body.solids import Body, pose_space
from bayes_body.model.dynamics.diffusion import TruncatedWalk, by_dof, standard_deviations

VELOCITY = "velocity"
# The first velocity of a dof whose velocity does not decay is 0, or as good as that: its standard deviation is this fraction of the noise.
CERTAIN = 1e-6

type Dofs = Float[np.ndarray, " dof"]


class Arguments(NamedTuple):
    """What the distributions need: radians, metres and seconds.

    Attributes:
        step_s: time between frames.
        sd: noise of the pose.
        velocity_sd: noise of the velocity.
        retention: share of the velocity that is kept from frame to frame.
        pull: change of the velocity from frame to frame for each unit of the distance to the pose at rest.
        rest_pose: the pose at rest.
        low: lower limits, or -∞.
        high: upper limits, or ∞.
    """

    step_s: Scalar
    sd: Pose
    velocity_sd: Pose
    retention: Pose
    pull: Pose
    rest_pose: Pose
    low: Pose
    high: Pose


class Options(Schema):
    """Options of `[dynamics] kind = "constant_velocity"`: standard deviations of every dof per frame at `at_fps`.

    `sd_deg` and `sd_m` are those of the pose, `velocity_sd_deg` and `velocity_sd_m` those of the velocity's change, in degrees and metres per second.
    Keys are names of dofs or patterns. All grow with the square root of the time between frames. `velocity_lasts_s` says after how many seconds a
    velocity has decayed to 1/e; a dof that is not named keeps its velocity, and begins with none. `spread_deg` is the standard deviation of an angle
    in the long run about `rest_deg`, which is 0 by default; an angle without one may go anywhere inside its limits.
    """

    sd_deg: Mapping[str, Positive] = {}
    """[degrees per frame] table, as for `diffusion`: noise of the angles."""
    sd_m: Mapping[str, Positive] = {}
    """[metres per frame] the same for translations."""
    velocity_sd_deg: Mapping[str, Positive] = {}
    """[degrees per second, per frame] table: noise of the angles' velocities."""
    velocity_sd_m: Mapping[str, Positive] = {}
    """[metres per second, per frame] the same for translations."""
    velocity_lasts_s: Mapping[str, Positive] = {}
    """[s] table: after this time a velocity has faded to 37 %. The first velocity then has its long-run distribution. Dofs without a value keep their
    velocity and begin with none."""
    spread_deg: Mapping[str, Positive] = {}
    """[degrees] table: standard deviation of an angle in the long run, about `rest_deg`. It needs a velocity that fades. Angles without a value are
    free."""
    rest_deg: Mapping[str, float] = {}
    """[degrees] table: the angle at rest, 0 for angles without a value."""
    at_fps: Positive = 60.0
    """[1/s] frame rate to which these values apply."""


def _conditional(arguments: Arguments, previous: State) -> dict[str, Distribution]:
    pose, velocity = previous[POSE], previous[VELOCITY]
    free = pose + arguments.step_s * velocity
    predicted = jnp.clip(free, arguments.low, arguments.high)
    # Where no limit is in reach, nothing is added.
    stopped = velocity + (predicted - free) / arguments.step_s
    onward = arguments.retention * stopped - arguments.pull * (pose - arguments.rest_pose)
    return {POSE: TruncatedWalk(predicted, arguments.sd, arguments.low, arguments.high), VELOCITY: _normal(onward, arguments.velocity_sd)}


def _perturbation(arguments: Arguments, state: State, scale: Scalar) -> dict[str, Distribution]:
    walk = TruncatedWalk(state[POSE], arguments.sd * scale, arguments.low, arguments.high)
    return {POSE: walk, VELOCITY: _normal(state[VELOCITY], arguments.velocity_sd * scale)}


def _normal(centre: Array, sd: Array) -> Distribution:
    return Normal(centre, sd).to_event(1)


def _begin(first: State) -> dict[str, Array]:
    return {POSE: first[POSE], VELOCITY: jnp.zeros_like(first[POSE])}


def _first_velocity(sd: Pose, first: State) -> dict[str, Distribution]:
    return {VELOCITY: _normal(first[VELOCITY], sd)}


@register("dynamics", "constant_velocity", Options)
def build(options: Options, body: Body, fps: float, **_: Any) -> Transition:
    """Build the process for one body and frame rate. It ignores the session's standard deviations of changes between frames, which are not its noise.

    Raises:
        InputError: the body is placed by parts, a dof has no standard deviation, a key of the options matches no dof, or a spread is so small that
            movements would grow.
    """
    require(body, POSE, "dynamics 'constant_velocity'", 'kind = "rigid_walk"')
    topology = body.skeleton.topology
    names, units = tuple(f"{name}_velocity" for name in topology.dof_names), tuple(f"{unit}/s" for unit in topology.dof_units)
    arguments, first_sd = _arguments(options, body, fps)
    return Transition(
        "constant_velocity",
        jax.tree_util.Partial(_conditional, arguments),
        jax.tree_util.Partial(_perturbation, arguments),
        begin=jax.tree_util.Partial(_begin),
        first=jax.tree_util.Partial(_first_velocity, first_sd) if options.velocity_lasts_s else None,
        spaces=((POSE, pose_space(body)), (VELOCITY, euclidean(names, units, "velocity_dof"))),
    )


def _arguments(options: Options, body: Body, fps: float) -> tuple[Arguments, Pose]:
    """Return what the distributions need, and the standard deviations of the first velocity."""
    topology = body.skeleton.topology
    dofs, angles = topology.dof_names, tuple(name for name, unit in zip(topology.dof_names, topology.dof_units, strict=True) if unit == "rad")
    tables = ((options.sd_deg, options.sd_m, ""), (options.velocity_sd_deg, options.velocity_sd_m, "velocity_"))
    by_name = [standard_deviations(degrees, metres, topology, prefix) for degrees, metres, prefix in tables]
    sd, velocity_sd = (np.array([deviations[name] for name in dofs]) for deviations in by_name)
    lasts = by_dof(options.velocity_lasts_s, dofs, "dynamics.velocity_lasts_s")
    spread = by_dof(options.spread_deg, angles, "dynamics.spread_deg")
    rest_deg = by_dof(options.rest_deg, angles, "dynamics.rest_deg")
    velocity = _fading(np.array([lasts.get(name, math.inf) for name in dofs]), velocity_sd, options.at_fps, fps)
    pull = [_pull(name, spread.get(name), velocity, index, fps) for index, name in enumerate(dofs)]

    def array(values: Any) -> Array:
        return device_array(values, body.lengths.dtype)

    arguments = Arguments(
        step_s=array(1 / fps),
        sd=array(sd * math.sqrt(options.at_fps / fps)),
        velocity_sd=array(velocity.sd),
        retention=array(velocity.decay),
        pull=array(pull),
        rest_pose=array([math.radians(rest_deg.get(name, 0.0)) for name in dofs]),
        low=body.skeleton.low,
        high=body.skeleton.high,
    )
    return arguments, array(velocity.first_sd)


class _Fading(NamedTuple):
    """The noise of velocities per frame, the share of each that is kept, and the standard deviation of the first."""

    sd: Dofs
    decay: Dofs
    first_sd: Dofs


def _fading(lasts: Dofs, sd: Dofs, at_fps: float, fps: float) -> _Fading:
    """Return the noise for velocities that last so long. Their stationary distribution is the same at every frame rate."""
    decay_at, decay = np.exp(-1 / (at_fps * lasts)), np.exp(-1 / (fps * lasts))
    with np.errstate(divide="ignore", invalid="ignore"):
        stationary = sd / np.sqrt(1 - decay_at**2)
        noise = np.where(decay == 1, sd * math.sqrt(at_fps / fps), stationary * np.sqrt(1 - decay**2))
    return _Fading(noise, decay, np.where(np.isfinite(stationary), stationary, CERTAIN * sd))


def _pull(name: str, spread_deg: float | None, velocity: _Fading, index: int, fps: float) -> float:
    """Return the pull of a dof's pose at rest, per frame."""
    if spread_deg is None:
        return 0.0
    decay, pull = float(velocity.decay[index]), float(velocity.first_sd[index] / math.radians(spread_deg)) ** 2 / fps
    # Otherwise the oscillation would grow from frame to frame.
    if not pull / fps < 1 - decay:
        problem = f"{spread_deg:g} degrees for '{name}', whose velocity is kept by {decay:.3g} from frame to frame"
        remedy = "give a larger spread, or let the velocity last less long"
        raise input_error(f"dynamics.spread_deg.{name}", problem, "a movement that is damped", remedy)
    return pull
