"""A box of joint limits as the support of a distribution. Sides may be infinite, and each dof has its own.

numpyro's `interval` uses a sigmoid as its bijector, which is NaN for an infinite side. Here a dof without limits keeps its own coordinate.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from numpyro.distributions import Distribution, biject_to, constraints
from numpyro.distributions.transforms import ParameterFreeTransform, Transform

from bayes_body.shapes import Pose


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
    r"""$s = \mathrm{low} + (\mathrm{high} - \mathrm{low})\,\sigma(x)$ where both sides are finite, $s = x$ elsewhere."""

    domain = constraints.real_vector  # pyright: ignore[reportAssignmentType, reportIncompatibleMethodOverride]

    def __init__(self, low: Pose, high: Pose):
        self.low, self.high = low, high

    @property
    def codomain(self) -> Box:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The box."""
        return Box(self.low, self.high)

    @property
    def _finite(self) -> Array:
        return jnp.isfinite(self.low) & jnp.isfinite(self.high)

    @property
    def _safe(self) -> tuple[Pose, Pose]:
        # Reverse mode differentiates both branches of a where, so the unused one must be finite too.
        return jnp.where(self._finite, self.low, 0.0), jnp.where(self._finite, self.high, 1.0)

    def __call__(self, x: Array) -> Array:
        """Map the real line into the box."""
        low, high = self._safe
        return jnp.where(self._finite, low + (high - low) * jax.nn.sigmoid(x), x)

    def _inverse(self, y: Array) -> Array:
        low, high = self._safe
        share = jnp.where(self._finite, (y - low) / (high - low), 0.5)
        tiny = jnp.finfo(y.dtype).eps
        return jnp.where(self._finite, jax.scipy.special.logit(jnp.clip(share, tiny, 1 - tiny)), y)

    def log_abs_det_jacobian(self, x: Array, y: Array, intermediates: Any = None) -> Array:
        """Sum over dofs of log |ds/dx|."""
        del y, intermediates
        low, high = self._safe
        bounded = jnp.log(high - low) + jax.nn.log_sigmoid(x) + jax.nn.log_sigmoid(-x)
        return jnp.sum(jnp.where(self._finite, bounded, 0.0), axis=-1)

    def tree_flatten(self) -> Any:
        """As for numpyro's transforms."""
        return (self.low, self.high), (("low", "high"), {})

    def __eq__(self, other: object) -> Any:
        return isinstance(other, BoxTransform) and jnp.array_equal(self.low, other.low) & jnp.array_equal(self.high, other.high)

    __hash__ = ParameterFreeTransform.__hash__


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
