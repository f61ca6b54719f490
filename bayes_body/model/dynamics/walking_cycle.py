r"""A walking prior (Sidenbladh, Black & Fleet 2000, 5): the pose follows from the phase of a learned walking cycle.

Coefficients c, phase $\mu$, position $\tau$, orientation $\theta$ (yaw, roll, pitch) and residual r are sampled. The pose is derived from them:

$$s = \mathrm{clip}\bigl(\bar s(\mu) + \textstyle\sum_k c_k m_k(\mu) + r,\ \mathrm{low},\ \mathrm{high}\bigr)$$

$$c_t \sim N(\rho\, c_{t-1},\ \epsilon^2), \quad \mu_t \sim N(\mu_{t-1} + f(c)\,\Delta t,\ \sigma_\mu^2), \quad
  \tau_t \sim N(\tau_{t-1} + v(c)\,\Delta t\,(\cos\psi, \sin\psi, 0),\ \sigma_\tau^2), \quad \theta_t \sim N(\theta_{t-1},\ \sigma_\theta^2)$$

The previous frame's coefficients and yaw $\psi$ are on the right. The learned stride rate f and speed v hold for a leg of length one and g = 1; a
longer leg has slower strides, by its square root. With $\rho^2 = 1 - \epsilon^2$ coefficients stay standard normal, as they were learned. The
printed form is $\rho = 1$, whose coefficients leave the range of all walkers in time, and a phase without drift; both are options.

With `heading_sd_deg`, the direction $\psi$ of the walk is a variable of its own, a random walk. The orientation is then an autoregressive process
around this direction and upright: the pelvis turns to both sides in a stride, and the walk does not follow it.

The residual is what the modes leave of the walks of other people, which the paper's prior lacks. Without it, no state of the model equals a new
person's pose, and the posterior is too narrow. Each angle's residual is an autoregressive process of first order with the learned standard deviation.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpyro.distributions import Distribution, Normal

from bayes_body.base.errors import input_error
from bayes_body.base.registry import register
from bayes_body.base.shapes import Pose, Scalar
from bayes_body.base.toml.schema import Positive, ProperShare, Schema
from bayes_body.density.factor import State, Transition
from bayes_body.density.spaces import Space, circle, euclidean
from bayes_body.model.body.branches import nearest_branch, settled
from bayes_body.model.body.kinematics import marker_positions
from bayes_body.model.body.placed_body import require
from bayes_body.model.body.placement import POSE
from bayes_body.model.body.solids import Body, pose_space
from bayes_body.model.dynamics.angle_cycle import NAME, AngleCycle, load_angle_cycle
from bayes_body.model.dynamics.diffusion import ROOT_DOFS, check_root

GRAVITY = 9.81
LEG = ("l_hip", "l_knee", "l_ankle")
# Phases among which that of the first pose is searched.
PHASES = 128
# No residual is more certain than this. The twist of the head, for one, is 0 in all learned walks, because no marker shows it.
LEAST_RESIDUAL = math.radians(1.0)
# Standard deviation of the error of a first pose, whose angles are fitted to a few points. Coefficients and phase allow for it. What they leave is
# the residual's, so that the state's pose is the given one.
FIRST_SD = math.radians(10.0)


class Options(Schema):
    """Options of `[dynamics] kind = "walking_cycle"`.

    Standard deviations are per frame at `at_fps` frames per second, and grow with the square root of the time between frames.
    """

    cycle: str = NAME
    """the cycle: a name in `models/learned/`, or the path of an `.npz` of `bayes-body learn walking-angles`."""
    drift: bool = True
    """false, as printed in the paper: the phase has no rate."""
    stationary: bool = True
    """false, as printed: the coefficients are a random walk, and leave the range of all walkers in time."""
    residual: bool = True
    """false, as in the paper: the pose is the cycle's exactly. No state equals a new person's pose, and the posterior is too narrow."""
    coefficient_sd: ProperShare = 0.1
    """[per frame] noise of the coefficients; 1 is their standard deviation between strides and people."""
    phase_sd: Positive = 0.006
    """[cycles per frame] noise of the phase."""
    position_sd_m: Positive = 0.008
    """[metres per frame] noise of the position, in each direction."""
    orientation_sd_deg: Positive = 1.2
    """[degrees per frame] noise of yaw, roll and pitch."""
    heading_sd_deg: Positive | None = None
    """[degrees per frame] noise of the direction of the walk. With it, the pelvis turns around this direction and upright, and returns to them.
    Without it, as in the paper, the walk follows the yaw, and yaw, roll and pitch are random walks."""
    upright_s: Positive = 0.5
    """[s] with `heading_sd_deg`: time in which a turn of the pelvis decays to 1/e."""
    residual_s: Positive = 0.5
    """[s] time in which a residual decays to 1/e; its standard deviation is the cycle's, at least 1°."""
    at_fps: Positive = 60.0
    """[1/s] frame rate to which these values apply; at another frame rate they scale with the square root of the time between frames."""


class _Walk(NamedTuple):
    """The arrays of the prior.

    `rate`: Fourier cycles per second and `speed`: m/s of the mean stride, with logarithmic changes by the coefficients. `sd`: per frame. `keep`: what
    remains of coefficients and residuals after a frame.
    """

    mean: Float[Array, "term dof"]
    modes: Float[Array, "mode term dof"]
    residual: Float[Array, " dof"]
    low: Pose
    high: Pose
    rate: Scalar
    rate_modes: Float[Array, " mode"]
    speed: Scalar
    speed_modes: Float[Array, " mode"]
    step_s: Scalar
    drift: Scalar
    lean: Scalar
    keep: State
    sd: State


def _terms(phase: Scalar, count: int) -> Float[Array, " term"]:
    angles = 2 * jnp.pi * phase * jnp.arange(1, count // 2 + 1)
    return jnp.concatenate([jnp.ones((1,), angles.dtype), jnp.cos(angles), jnp.sin(angles)])


def _derive(walk: _Walk, sampled: State) -> dict[str, Array]:
    T = _terms(sampled["phase"][0], len(walk.mean))
    joints = T @ walk.mean + sampled["coefficients"] @ jnp.tensordot(T, walk.modes, ((0,), (1,)))
    pose = jnp.concatenate([sampled["position"], sampled["orientation"], joints + sampled.get("residual", 0.0)])
    return {"pose": jnp.clip(pose, walk.low, walk.high)}


def _conditional(walk: _Walk, previous: State) -> dict[str, Distribution]:
    coefficients, orientation = previous["coefficients"], previous["orientation"]
    heading = previous.get("heading", orientation[:1])
    upright = jnp.concatenate([heading, jnp.zeros_like(orientation[1:])])
    rate = walk.rate * jnp.exp(walk.rate_modes @ coefficients)
    forward = walk.speed * jnp.exp(walk.speed_modes @ coefficients) * walk.step_s
    moved = {
        "phase": previous["phase"] + walk.drift * rate * walk.step_s,
        "position": previous["position"] + forward * jnp.concatenate([jnp.cos(heading), jnp.sin(heading), jnp.zeros_like(heading)]),
        "orientation": upright + walk.lean * (orientation - upright),
        "heading": heading,
    }
    decayed = {name: share * previous[name] for name, share in walk.keep.items()}
    return {name: _normal(centre, walk.sd[name]) for name, centre in (moved | decayed).items() if name in walk.sd}


def _perturbation(walk: _Walk, state: State, scale: Scalar) -> dict[str, Distribution]:
    return {name: _normal(state[name], sd * scale) for name, sd in walk.sd.items()}


def _normal(centre: Array, sd: Array) -> Distribution:
    return Normal(centre, jnp.broadcast_to(sd, centre.shape)).to_event(1)


@jax.jit
def _begin(walk: _Walk, body: Body, first: State) -> dict[str, Array]:
    """Return the most likely state given a first pose with errors: ridge regression of the coefficients at each of many phases."""
    first_pose = jnp.asarray(first["pose"], walk.mean.dtype)
    branch = nearest_branch(body.skeleton.topology, first_pose, jnp.concatenate([first_pose[:ROOT_DOFS], walk.mean[0]]))
    pose = settled(body, branch(first_pose))
    variance = walk.residual**2 + FIRST_SD**2

    def regress(phase: Scalar) -> tuple[Scalar, Array, Array]:
        T = _terms(phase, len(walk.mean))
        deviation = pose[ROOT_DOFS:] - T @ walk.mean
        basis = jnp.tensordot(walk.modes, T, ((1,), (0,)))
        coefficients = jnp.linalg.solve((basis / variance) @ basis.T + jnp.eye(len(basis), dtype=basis.dtype), (basis / variance) @ deviation)
        residual = deviation - coefficients @ basis
        return jnp.sum(residual**2 / variance) + jnp.sum(coefficients**2), coefficients, residual

    phases = jnp.arange(PHASES, dtype=walk.mean.dtype) / PHASES
    costs, coefficients, residuals = jax.vmap(regress)(phases)
    best = jnp.argmin(costs)
    state = {"coefficients": coefficients[best], "phase": phases[best][None], "position": pose[:3], "orientation": pose[3:ROOT_DOFS]}
    optional = {"residual": residuals[best], "heading": pose[3:4]}
    state |= {name: value for name, value in optional.items() if name in walk.sd}
    # The transition to frame 0 walks one step. The first pose is that of frame 0, so the state before it is a step behind.
    next_step = _conditional(walk, state)
    state |= {name: 2 * state[name] - next_step[name].mean for name in ("phase", "position")}
    return state | _derive(walk, state)


@register("dynamics", "walking_cycle", Options)
def build(options: Options, body: Body, fps: float, **_: Any) -> Transition:
    """Build the prior for one body and frame rate. It ignores the session's standard deviations of changes between frames, which are not its noise.

    Raises:
        InputError: the cycle cannot be read or is of another body, the body is not placed by angles, or its first joint does not place it.
    """
    require(body, POSE, "dynamics 'walking_cycle'", 'kind = "rigid_walk"')
    cycle = load_angle_cycle(options.cycle)
    _check(cycle, body)
    walk = _arrays(options, cycle, body, fps)
    partial = jax.tree_util.Partial
    return Transition(
        "walking_cycle",
        partial(_conditional, walk),
        partial(_perturbation, walk),
        begin=partial(_begin, walk, body),
        derive=partial(_derive, walk),
        spaces=_spaces(cycle, body),
    )


def _spaces(cycle: AngleCycle, body: Body) -> tuple[tuple[str, Space], ...]:
    names, modes = body.dof_names, tuple(f"mode_{k + 1}" for k in range(len(cycle.modes)))
    return (
        (POSE, pose_space(body)),
        ("coefficients", euclidean(modes, ("sd",) * len(modes), "mode")),
        # Cycles are counted, so that the phase is no angle.
        ("phase", euclidean(("phase",), ("cycles",), "phase_entry")),
        ("position", euclidean(names[:3], ("m",) * 3, "shift")),
        ("orientation", circle(names[3:ROOT_DOFS], "turn")),
        ("heading", circle(("heading",), "heading_entry")),
        ("residual", euclidean(tuple(f"residual_{name}" for name in cycle.names), ("rad",) * len(cycle.names), "joint_dof")),
    )


def _check(cycle: AngleCycle, body: Body) -> None:
    check_root(body, "dynamics walking_cycle")
    if cycle.names != body.dof_names[ROOT_DOFS:]:
        problem = f"the cycle was learned on the body '{cycle.body}', and the model's body '{body.name}' has other dofs"
        raise input_error("dynamics.cycle", problem, "a cycle of the model's body", "learn one with `bayes-body learn walking-angles --body`")
    if not set(LEG) <= set(body.markers.names):
        raise input_error(f"body '{body.name}'", "no markers of the left leg", f"the markers {', '.join(LEG)}", "add them to the body file")


def _arrays(options: Options, cycle: AngleCycle, body: Body, fps: float) -> _Walk:
    dtype, frames = body.lengths.dtype, options.at_fps / fps
    leg = _leg_length(body)
    root, legs = jnp.sqrt(leg / GRAVITY), jnp.asarray(cycle.pace[1], dtype)
    spread = jnp.asarray(np.maximum(cycle.residual, LEAST_RESIDUAL), dtype)
    share = (1 - options.coefficient_sd**2) ** (frames / 2) if options.stationary else 1.0
    noise = math.sqrt(1 - share**2) if options.stationary else options.coefficient_sd * math.sqrt(frames)
    walked = math.sqrt(frames)
    sd: dict[str, Any] = {
        "coefficients": noise,
        "phase": options.phase_sd * walked,
        "position": options.position_sd_m * walked,
        "orientation": math.radians(options.orientation_sd_deg) * walked,
    }
    lean = 1.0
    if options.heading_sd_deg is not None:
        lean = math.exp(-1 / (fps * options.upright_s))
        sd["heading"] = math.radians(options.heading_sd_deg) * walked
    keep = {"coefficients": share}
    if options.residual:
        keep["residual"] = math.exp(-1 / (fps * options.residual_s))
        sd["residual"] = spread * math.sqrt(1 - keep["residual"] ** 2)
    return _Walk(
        mean=jnp.asarray(cycle.mean, dtype),
        modes=jnp.asarray(cycle.modes, dtype),
        residual=spread,
        low=body.skeleton.low,
        high=body.skeleton.high,
        rate=jnp.exp(-jnp.asarray(cycle.pace[0], dtype)) / root,
        rate_modes=-jnp.asarray(cycle.pace_modes[:, 0], dtype),
        speed=leg / root * jnp.exp(legs - jnp.asarray(cycle.pace[0], dtype)),
        speed_modes=jnp.asarray(cycle.pace_modes[:, 1] - cycle.pace_modes[:, 0], dtype),
        step_s=jnp.asarray(1 / fps, dtype),
        drift=jnp.asarray(float(options.drift), dtype),
        lean=jnp.asarray(lean, dtype),
        keep={name: jnp.asarray(value, dtype) for name, value in keep.items()},
        sd={name: jnp.asarray(value, dtype) for name, value in sd.items()},
    )


@jax.jit
def _leg_length(body: Body) -> Scalar:
    """Return the length of thigh and shank together, metres."""
    places = marker_positions(body.skeleton, body.markers, jnp.clip(jnp.zeros_like(body.skeleton.low), body.skeleton.low, body.skeleton.high))
    hip, knee, ankle = (places[body.markers.names.index(name)] for name in LEG)
    return jnp.linalg.norm(knee - hip) + jnp.linalg.norm(ankle - knee)
