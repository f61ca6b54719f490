"""Unconstrained parameters of a fit: the logit of an angle's share of its range, so that a step of Adam moves all angles by similar shares.

A sampler's coordinates (`model/dynamics/limits.py`) differ, because they should have the same scales for all particles.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bayes_body.model.body.skeleton import Skeleton


def pose_of(skeleton: Skeleton, parameters: Float[Array, "*batch dof"]) -> Float[Array, "*batch dof"]:
    """Return the pose, radians and metres, within its limits. A dof without limits is its own parameter."""
    limited, low, width = _ranges(skeleton)
    return jnp.where(limited, low + width * jax.nn.sigmoid(parameters), parameters)


def parameters_of(skeleton: Skeleton, pose: Float[Array, "*batch dof"]) -> Float[Array, "*batch dof"]:
    """Return the parameters of a pose, the inverse of `pose_of`."""
    limited, low, width = _ranges(skeleton)
    tiny = jnp.finfo(pose.dtype).eps
    share = jnp.clip(jnp.where(limited, (pose - low) / width, 0.5), tiny, 1 - tiny)
    return jnp.where(limited, jax.scipy.special.logit(share), pose)


def _ranges(skeleton: Skeleton) -> tuple[Array, Array, Array]:
    """Return which dofs are limited, their lower limits, and the widths of their ranges."""
    limited = jnp.isfinite(skeleton.low) & jnp.isfinite(skeleton.high)
    # Reverse mode differentiates both branches of a where, so the unused one must be finite too.
    low = jnp.where(limited, skeleton.low, 0.0)
    return limited, low, jnp.where(limited, skeleton.high, 1.0) - low
