"""A box of joint limits as the support of a distribution. Sides may be infinite, and each dof has its own.

numpyro's `interval` has a sigmoid as its bijector. It is NaN for an infinite side, and it is curved everywhere: near a limit, particles that are a
few degrees apart have scales that differ many times, and no mass matrix suits them all. The bijector here bends only within a few degrees of a limit.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from numpyro.distributions import Distribution, biject_to, constraints
from numpyro.distributions.transforms import ParameterFreeTransform, Transform

from bayes_body.base.shapes import Pose

# The length over which a coordinate bends at a limit: radians (three degrees) or metres. It should be about the standard deviation of a posterior:
# a longer bend gives particles different scales, a shorter one makes the limit a hard wall.
BEND = 0.05


class Box(constraints.Constraint):
    """low ≤ x ≤ high along the last axis; radians or metres, ±inf if there is no limit."""

    event_dim = 1

    def __init__(self, low: Pose, high: Pose):
        self.low, self.high = low, high

    def __call__(self, x: Float[Array, "*batch dof"]) -> Any:
        """Whether x is in the box."""
        return jnp.all((x >= self.low) & (x <= self.high), axis=-1)

    def feasible_like(self, prototype: Array) -> Array:
        """A point inside the box."""
        return BoxTransform(self.low, self.high)(jnp.zeros_like(prototype))

    def tree_flatten(self) -> Any:
        """As for numpyro's constraints."""
        return (self.low, self.high), (("low", "high"), {})


class BoxTransform(Transform):
    r"""The identity away from the limits. Within about $\ell$ of a limit, x is like the logarithm of the distance to it.

    $s = x + \ell\,(\operatorname{softplus}\frac{\mathrm{low} - x}{\ell} - \operatorname{softplus}\frac{x - \mathrm{high}}{\ell})$.
    """

    domain = constraints.real_vector  # pyright: ignore[reportAssignmentType, reportIncompatibleMethodOverride]

    def __init__(self, low: Pose, high: Pose):
        self.low, self.high = low, high

    @property
    def codomain(self) -> Box:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The box."""
        return Box(self.low, self.high)

    def __call__(self, x: Array) -> Array:
        """Map the real line into the box."""
        return _bent(x, self.low, self.high)

    def _inverse(self, y: Array) -> Array:
        bend = _bend(self.low, self.high)
        tiny = bend * jnp.finfo(y.dtype).eps
        below, above = jnp.maximum(y - self.low, tiny) / bend, jnp.maximum(self.high - y, tiny) / bend
        return y + bend * (_log1mexp(below) - _log1mexp(above))

    def log_abs_det_jacobian(self, x: Array, y: Array, intermediates: Any = None) -> Array:
        """Sum over dofs of log |ds/dx|."""
        del y, intermediates
        return jnp.sum(_log_slope(x, self.low, self.high), axis=-1)

    def tree_flatten(self) -> Any:
        """As for numpyro's transforms."""
        return (self.low, self.high), (("low", "high"), {})

    def __eq__(self, value: object) -> Any:
        return isinstance(value, BoxTransform) and jnp.array_equal(self.low, value.low) & jnp.array_equal(self.high, value.high)

    __hash__ = ParameterFreeTransform.__hash__


@jax.custom_jvp
def _bent(x: Array, low: Pose, high: Pose) -> Array:
    bend = _bend(low, high)
    return jnp.clip(x + bend * (jax.nn.softplus((low - x) / bend) - jax.nn.softplus((x - high) / bend)), low, high)


@_bent.defjvp
def _slope(values: tuple[Array, Pose, Pose], tangents: tuple[Array, Pose, Pose]) -> tuple[Array, Array]:
    """The slope by x; limits are constants. Differentiating the sum above would round it to 0 beyond a limit."""
    return _bent(*values), jnp.exp(_log_slope(*values)) * tangents[0]


def _log_slope(x: Array, low: Pose, high: Pose) -> Array:
    bend = _bend(low, high)
    return _log1mexp((high - low) / bend) - jax.nn.softplus((low - x) / bend) - jax.nn.softplus((x - high) / bend)


def _bend(low: Pose, high: Pose) -> Pose:
    return jnp.minimum(BEND, (high - low) / 4)


def _log1mexp(distance: Array) -> Array:
    """log(1 - exp(-distance))."""
    return jnp.log(-jnp.expm1(-distance))


@biject_to.register(Box)
def _biject_to_box(constraint: Box) -> BoxTransform:
    return BoxTransform(constraint.low, constraint.high)


class InBox(Distribution):
    """The base of distributions of independent dofs inside joint limits: `scale`, `low` and `high` of each dof, radians or metres."""

    scale: Pose
    low: Pose
    high: Pose

    # numpyro gathers both in a set, whose order differs between processes. Then the program would differ too, and the compilation cache would miss.
    @classmethod
    def gather_pytree_data_fields(cls) -> tuple[str, ...]:
        """In alphabetical order."""
        return tuple(sorted(super().gather_pytree_data_fields()))

    @classmethod
    def gather_pytree_aux_fields(cls) -> tuple[str, ...]:
        """In alphabetical order."""
        return tuple(sorted(super().gather_pytree_aux_fields()))

    # numpyro declares the base class for its own decorators; the signatures below are the ones that it calls.
    @constraints.dependent_property(is_discrete=False, event_dim=1)  # pyright: ignore[reportArgumentType]
    def support(self) -> Box:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The joint limits."""
        return Box(self.low, self.high)

    @property
    def variance(self) -> Pose:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The variance of the noise, before truncation by limits or wrapping around a circle."""
        return self.scale**2
