r"""A random walk of rigid parts, each on its own (Sigal et al. 2011, q4): for the loose-limbed body.

$$t_t \sim \mathcal N(t_{t-1}, \sigma^2 I), \qquad q_t = q_{t-1} e^{\omega}, \quad \omega \sim \mathcal N(0, \varsigma^2 I).$$

The density is with respect to the Haar measure $dt\,dR$: $\mathcal N(\omega)$ over the Jacobian of the exponential map. What keeps the parts together
is a potential (model/potentials/kinematic.py). The product of both is not normalised given the previous frame, as with any constraint.
"""

import math
from collections.abc import Mapping
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpyro.distributions import Distribution, constraints
from pydantic import Field

from bayes_body.base.errors import input_error
from bayes_body.base.geometry import rigid, rotations
from bayes_body.base.geometry.namespaces import device_array
from bayes_body.base.registry import register
from bayes_body.base.shapes import Key, Scalar
from bayes_body.base.toml.schema import Positive, Schema
from bayes_body.density.chart import ChartAround
from bayes_body.density.factor import State, Transition
from bayes_body.model.body.placed_body import require
from bayes_body.model.body.placement import PARTS, ByParts
from bayes_body.model.body.solids import Body, configuration_space
from bayes_body.model.dynamics.diffusion import by_part

# With a larger standard deviation, more than a ten-millionth of the draws would be beyond a half turn, where the density ends.
LARGEST_DEG = 30.0


class Options(Schema):
    """Options of `[dynamics] kind = "rigid_walk"`: standard deviations per frame at `at_fps`, by names of parts or patterns."""

    sd_m: Mapping[str, Positive] = {"*": 0.03}
    """[metres per frame] table: a part's name or a pattern = the standard deviation of its origin along each axis."""
    sd_deg: Mapping[str, Annotated[float, Field(strict=True, gt=0)]] = {"*": 6.0}
    """[degrees per frame] the same for its rotation about each of its axes; at most 30 at the recording's frame rate."""
    at_fps: Positive = 60.0
    """[1/s] frame rate to which these values apply; at another frame rate they scale with the square root of the time between frames."""


class RigidWalk(Distribution):
    """Independent steps of rigid parts, around `loc` (part, 7), with standard deviations `sd_m` and `sd_rad` (part,); scalar log_prob.

    It is also the distribution of one part, (7,), as which message passing takes it (`entries`).
    """

    arg_constraints = {"loc": constraints.real_matrix, "sd_m": constraints.real_vector, "sd_rad": constraints.real_vector}
    support = constraints.real_matrix  # pyright: ignore[reportAssignmentType, reportIncompatibleMethodOverride]
    reparametrized_params = ["loc", "sd_m", "sd_rad"]
    pytree_data_fields = ("loc", "sd_m", "sd_rad")

    def __init__(self, loc: Array, sd_m: Array, sd_rad: Array, *, validate_args: bool | None = None):
        self.loc, self.sd_m, self.sd_rad = loc, sd_m, sd_rad
        super().__init__(batch_shape=(), event_shape=loc.shape, validate_args=validate_args)

    @classmethod
    def gather_pytree_data_fields(cls) -> tuple[str, ...]:
        """In alphabetical order, as in `InBox`."""
        return tuple(sorted(super().gather_pytree_data_fields()))

    @property
    def variance(self) -> Float[Array, "*part 6"]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The variance of every part's step (v, ω), m² and rad²."""
        return jnp.stack([self.sd_m**2] * 3 + [self.sd_rad**2] * 3, axis=-1)

    def entries(self) -> "RigidWalk":
        """Return the distributions of the parts, stacked: arrays with a leading axis of parts."""
        return self

    def sample(self, key: Key, sample_shape: tuple[int, ...] = ()) -> Float[Array, "*sample 7"]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Draw a step of every part."""
        steps = jnp.sqrt(self.variance) * jax.random.normal(key, (*sample_shape, *self.loc.shape[:-1], 6), self.loc.dtype)
        turned = rotations.multiply(self.loc[..., 3:], rotations.exponential(steps[..., 3:]))
        return jnp.asarray(rigid.rigid(self.loc[..., :3] + steps[..., :3], rotations.normalised(turned)))

    def log_prob(self, value: Float[Array, "*part 7"], intermediates: Any = None) -> Scalar:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The log-density with respect to the Haar measure."""
        del intermediates
        w = rotations.logarithm(rotations.multiply(rotations.conjugate(self.loc[..., 3:]), value[..., 3:]))
        steps = jnp.concatenate([value[..., :3] - self.loc[..., :3], w], axis=-1)
        normal = -0.5 * (steps**2 / self.variance + jnp.log(2 * math.pi * self.variance))
        return jnp.sum(normal) - jnp.sum(rotations.log_jacobian(w))

    def log_prob_of_pairs(self, values: Float[Array, "value 7"]) -> Float[Array, "value step"]:
        """Return `log_prob` of all values under each of many steps of one part, whose fields are stacked. Its error is below 1e-3 in float32."""
        versine = rotations.away(values[:, 3:], self.loc[:, 3:])
        squared_angle = rotations.squared(versine) * versine * (2 - versine)
        squared_distance = jnp.sum((values[:, None, :3] - self.loc[None, :, :3]) ** 2, axis=-1)
        constants = -3 * jnp.log(2 * math.pi * self.sd_m * self.sd_rad) - 2 * math.log(2)
        normal = -0.5 * (squared_distance / self.sd_m**2 + squared_angle / self.sd_rad**2)
        return normal + constants + rotations.log_squared(versine)


def _walk(sd_m: Array, sd_rad: Array, previous: State) -> dict[str, Distribution]:
    return {PARTS: RigidWalk(previous[PARTS], sd_m, sd_rad)}


def _noise(sd_m: Array, sd_rad: Array, state: State, scale: Scalar) -> dict[str, Distribution]:
    return {PARTS: RigidWalk(state[PARTS], sd_m * scale, sd_rad * scale)}


def _begin(body: Body, first: State) -> dict[str, Array]:
    return {PARTS: body.placement.configuration(body.skeleton, first["pose"])}


@register("dynamics", "rigid_walk", Options)
def build(options: Options, body: Body, fps: float, **_: Any) -> Transition:
    """Build the random walk for one body and frame rate.

    Raises:
        InputError: the body is placed by angles, a part has no standard deviation or too large a one, or a key matches no part.
    """
    require(body, PARTS, "dynamics 'rigid_walk'", 'kind = "diffusion"')
    assert isinstance(body.placement, ByParts)
    names, factor, dtype = body.placement.names, math.sqrt(options.at_fps / fps), body.lengths.dtype
    sd_m = device_array(np.asarray(by_part(options.sd_m, names, "dynamics.sd_m")) * factor, dtype)
    degrees = [sd * factor for sd in by_part(options.sd_deg, names, "dynamics.sd_deg")]
    if max(degrees) > LARGEST_DEG:
        name = names[degrees.index(max(degrees))]
        problem = f"{max(degrees):.3g} degrees per frame for '{name}' at {fps:g} fps"
        raise input_error("dynamics.sd_deg", problem, f"at most {LARGEST_DEG:g}", "give a smaller value")
    arguments = (sd_m, device_array(np.radians(degrees), dtype))
    return Transition(
        "rigid_walk",
        jax.tree_util.Partial(_walk, *arguments),
        jax.tree_util.Partial(_noise, *arguments),
        begin=jax.tree_util.Partial(_begin, body),
        chart=ChartAround(PARTS, body.placement.parents),
        spaces=((PARTS, configuration_space(body)),),
    )
