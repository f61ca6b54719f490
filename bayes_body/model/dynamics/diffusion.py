r"""A random walk inside the joint limits (Darby, Li & Costen 2008, 6.2: "the addition of noise", covariance P diagonal):

$$s_t^k \mid s_{t-1}^k \sim \mathcal{N}(s_{t-1}^k, \sigma_k^2) \text{ truncated to } [\mathrm{low}_k, \mathrm{high}_k].$$

The truncated normal is normalised for each previous state: near a limit its density is higher, which rejection after drawing would ignore. The paper
sets $\sigma_k$ to half the largest change between two frames of a training motion.

A definition gives the standard deviations per frame by names of dofs or parts, or by patterns, at one frame rate.

If a learned motion prior moves a body, the dofs of the body's first joint must be the position and the orientation in the world (`check_root`).
"""

import math
from collections.abc import Mapping
from fnmatch import fnmatchcase
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from numpyro.distributions import Distribution, constraints

from bayes_body.base.errors import InputError, input_error, nearest
from bayes_body.base.geometry.namespaces import device_array
from bayes_body.base.registry import register
from bayes_body.base.shapes import Key, Pose, Scalar
from bayes_body.base.toml.schema import Positive, Schema
from bayes_body.density.factor import State, Transition
from bayes_body.model.body.placed_body import require
from bayes_body.model.body.placement import POSE
from bayes_body.model.body.skeleton import Topology
from bayes_body.model.body.solids import Body, pose_space
from bayes_body.model.dynamics.limits import InBox


def by_part(table: Mapping[str, float], names: tuple[str, ...], field: str) -> list[float]:
    """The number of every part, from names or patterns. An exact name wins, else the first pattern that matches.

    Raises:
        InputError: a part has none, or a key matches no part.
    """
    _check_keys(table, names, field, "part")
    numbers = []
    for name in names:
        key = key_of(name, table)
        if key is None:
            raise InputError(f"{field}: none for the part '{name}'; expected one for every part; add '{name}' or a pattern.")
        numbers.append(table[key])
    return numbers


def by_dof(table: Mapping[str, float], names: tuple[str, ...], field: str, kind: str = "dof") -> dict[str, float]:
    """The numbers of those dofs, or things of another kind, that have one, from names or patterns.

    Raises:
        InputError: a key matches none of them.
    """
    _check_keys(table, names, field, kind)
    return {name: table[key] for name in names if (key := key_of(name, table)) is not None}


def standard_deviations(sd_deg: Mapping[str, float], sd_m: Mapping[str, float], topology: Topology, prefix: str = "") -> dict[str, float]:
    """The standard deviation of every dof, radians or metres. An exact name wins, else the first pattern that matches.

    Args:
        sd_deg: those of angles, degrees.
        sd_m: those of shifts, metres.
        topology: the body's dofs.
        prefix: what the names of the two tables begin with in the definition, such as "velocity_".

    Raises:
        InputError: a dof has none, or a key matches no dof.
    """
    deviations = known_deviations(sd_deg, sd_m, topology, f"dynamics.{prefix}")
    for name, unit in zip(topology.dof_names, topology.dof_units, strict=True):
        if name not in deviations:
            field = f"dynamics.{prefix}{'sd_deg' if unit == 'rad' else 'sd_m'}"
            raise InputError(f"{field}: no standard deviation for the dof '{name}'; expected one for every dof; add '{name}' or a pattern.")
    return deviations


def known_deviations(sd_deg: Mapping[str, float], sd_m: Mapping[str, float], topology: Topology, place: str) -> dict[str, float]:
    """The standard deviations of those dofs that have one, radians or metres.

    Raises:
        InputError: a key matches no dof.
    """
    deviations: dict[str, float] = {}
    for unit, field, table, si in (("rad", "sd_deg", sd_deg, math.pi / 180), ("m", "sd_m", sd_m, 1.0)):
        dofs = [name for name, u in zip(topology.dof_names, topology.dof_units, strict=True) if u == unit]
        for key in table:
            if not any(fnmatchcase(name, key) for name in dofs):
                measure = "degrees" if unit == "rad" else "metres"
                raise InputError(f"{place}{field}.{key}: matches no dof of the body in {measure}; {nearest(key, dofs)}")
        for name in dofs:
            key = key_of(name, table)
            if key is not None:
                deviations[name] = table[key] * si
    return deviations


def key_of(name: str, table: Mapping[str, float]) -> str | None:
    """Return the key of a table that is meant for a name: the name itself, or the first pattern that matches; None if there is none."""
    return name if name in table else next((pattern for pattern in table if fnmatchcase(name, pattern)), None)


def _check_keys(table: Mapping[str, float], names: tuple[str, ...], field: str, kind: str) -> None:
    for key in table:
        if not any(fnmatchcase(name, key) for name in names):
            raise InputError(f"{field}.{key}: matches no {kind} of the body; {nearest(key, names)}")


# Its dofs, in order: shifts along x, y, z, then rotations about z (yaw), x, y. The second entry says whether it is a shift.
ROOT = ((0, True), (1, True), (2, True), (2, False), (0, False), (1, False))
ROOT_DOFS = len(ROOT)


def check_root(body: Body, user: str) -> None:
    """Check that the dofs of a body's first joint are its position and orientation in the world.

    Args:
        body: the body.
        user: what needs these dofs, such as "dynamics walking_cycle".

    Raises:
        InputError: the first joint has other dofs.
    """
    topology = body.skeleton.topology
    root = tuple((motion.axis, motion.is_shift) for motion in topology.motions[0] if motion.sign == 1)
    if root != ROOT or [motion.dof for motion in topology.motions[0]] != list(range(ROOT_DOFS)):
        problem = f"the first joint of the body '{body.name}' is {topology.joint_names[0]}, with other dofs"
        raise input_error(user, problem, "a first joint with the dofs tx, ty, tz, z, x, y in this order", "name another body")


ROOT_HALF = math.sqrt(0.5)


class Options(Schema):
    """Options of `[dynamics] kind = "diffusion"`: a standard deviation per frame for every dof.

    Keys are names of dofs or patterns (`*_hip_?`); an exact name wins, else the first pattern that matches. The values are valid at the frame rate
    `at_fps`. A random walk's standard deviation grows with the square root of the time between frames.
    """

    sd_deg: Mapping[str, Positive] = {}
    """[degrees per frame] table: a dof's name or a pattern (`*`, `?`, `[xy]`) = its standard deviation, for angles."""
    sd_m: Mapping[str, Positive] = {}
    """[metres per frame] the same for translations."""
    at_fps: Positive = 60.0
    """[1/s] frame rate to which these values apply; at another frame rate they scale with the square root of the time between frames."""
    use_subject_sd: bool = True
    """whether the session's own standard deviations, if it has any, replace these."""


class TruncatedWalk(InBox):
    """A normal distribution truncated to a box, with possibly infinite sides: independent dofs, scalar log_prob."""

    arg_constraints = {"loc": constraints.real_vector, "scale": constraints.real_vector}
    reparametrized_params = ["loc", "scale"]
    pytree_data_fields = ("loc", "scale", "low", "high")

    def __init__(self, loc: Pose, scale: Pose, low: Pose, high: Pose, *, validate_args: bool | None = None):
        self.loc, self.scale, self.low, self.high = loc, scale, low, high
        super().__init__(batch_shape=(), event_shape=loc.shape, validate_args=validate_args)

    @property
    def _sides(self) -> tuple[Pose, Pose]:
        return (self.low - self.loc) / self.scale, (self.high - self.loc) / self.scale

    def sample(self, key: Key, sample_shape: tuple[int, ...] = ()) -> Float[Array, "*sample dof"]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Sample by inversion: one uniform number per dof, whatever the limits."""
        return self.icdf(jax.random.uniform(key, (*sample_shape, *self.event_shape), self.loc.dtype))

    def icdf(self, q: Float[Array, "*sample dof"]) -> Float[Array, "*sample dof"]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return the values below which the dofs lie with probabilities q.

        The inversion is between the erf values of the two sides, not between their probabilities. This takes two thirds of the time of ndtri, and is
        as exact while `loc` is inside the box.
        """
        low, high = (jax.lax.erf(side * ROOT_HALF) for side in self._sides)
        nearly_one = 1 - jnp.finfo(self.loc.dtype).epsneg
        z = jax.lax.erf_inv(jnp.clip(low + (high - low) * q, -nearly_one, nearly_one)) / ROOT_HALF
        return jnp.clip(self.loc + self.scale * z, self.low, self.high)

    def log_prob(self, value: Pose, intermediates: Any = None) -> Scalar:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The log-density; minus infinity outside the limits."""
        del intermediates
        z = (value - self.loc) / self.scale
        density = -0.5 * z * z - jnp.log(self.scale) - 0.5 * math.log(2 * math.pi) - _log_mass(*self._sides)
        return jnp.sum(jnp.where((value >= self.low) & (value <= self.high), density, -jnp.inf), axis=-1)


@jax.custom_jvp
def _log_mass(a: Pose, b: Pose) -> Pose:
    r"""$\log(\Phi(b) - \Phi(a))$ for a ≤ 0 ≤ b, which holds as `loc` is inside the box: no digits cancel then."""
    return jnp.log(0.5 * (jax.lax.erf(ROOT_HALF * b) - jax.lax.erf(ROOT_HALF * a)))


@_log_mass.defjvp
def _log_mass_slope(sides: tuple[Pose, Pose], tangents: tuple[Pose, Pose]) -> tuple[Pose, Pose]:
    """In the ordinary rule, an infinite side would give infinity times zero. Beyond 30 standard deviations the clamp makes no difference."""
    log_mass, (a, b) = _log_mass(*sides), (jnp.clip(side, -30.0, 30.0) for side in sides)
    below, above = (jnp.exp(-0.5 * side * side - log_mass) / math.sqrt(2 * math.pi) for side in (a, b))
    return log_mass, jnp.where(b < 30.0, above * tangents[1], 0.0) - jnp.where(a > -30.0, below * tangents[0], 0.0)


def _walk(sd: Pose, low: Pose, high: Pose, previous: State) -> dict[str, Distribution]:
    return {"pose": TruncatedWalk(previous["pose"], sd, low, high)}


def _noise(sd: Pose, low: Pose, high: Pose, state: State, scale: Scalar) -> dict[str, Distribution]:
    return {"pose": TruncatedWalk(state["pose"], sd * scale, low, high)}


@register("dynamics", "diffusion", Options)
def build(options: Options, body: Body, fps: float, subject_sd: Mapping[str, float] | None = None, gap: float = 1.0, **_: Any) -> Transition:
    """Build the random walk for one body and frame rate, over `gap` frames.

    Raises:
        InputError: a dof has no standard deviation, or a key of the options matches no dof.
    """
    require(body, POSE, "dynamics 'diffusion'", 'kind = "rigid_walk"')
    topology = body.skeleton.topology
    factor = math.sqrt(options.at_fps / fps)
    by_name = {name: sd * factor for name, sd in standard_deviations(options.sd_deg, options.sd_m, topology).items()}
    if options.use_subject_sd and subject_sd:
        by_name |= {name: sd for name, sd in subject_sd.items() if name in by_name}
    sd = device_array([math.sqrt(gap) * by_name[name] for name in topology.dof_names], body.lengths.dtype)
    arguments = (sd, body.skeleton.low, body.skeleton.high)
    walk, noise = jax.tree_util.Partial(_walk, *arguments), jax.tree_util.Partial(_noise, *arguments)
    return Transition("diffusion", walk, noise, spaces=((POSE, pose_space(body)),))
