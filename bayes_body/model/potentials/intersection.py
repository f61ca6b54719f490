r"""A constraint: parts do not penetrate each other.

Darby, Li & Costen (2008, 6.1) give such poses "a zero weighting". With the sphere approximations of Sigal et al. (2011, (7)), and $d$ the depth of
the deepest pair of spheres of two parts, minus the depth by which flesh yields,

$$\log C = -\infty \text{ if any } d > 0 \quad (\text{hard}), \qquad
\log C = -\tfrac12 \sum_{\text{pairs}} \big(\max(d, 0) / \sigma\big)^2 \quad (\text{soft}).$$

As a constraint it has full power at every temperature. It has no normaliser of its own: a kernel's evidence estimate contains the share of the
prediction that it excludes. The soft form is for kernels that need a gradient.
"""

from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bayes_body.base.geometry.transforms import Transform
from bayes_body.base.registry import register
from bayes_body.base.shapes import Configuration, Scalar
from bayes_body.base.toml.schema import NonNegative, Positive, Schema
from bayes_body.density.factor import Composed, Factor, Variable, Variables
from bayes_body.model.body.solids import Body, part_transforms, penetration_depths, smooth_penetration_depths, widened


class Options(Schema):
    """Options of `[[constraint]] kind = "intersection"`. The body's `penetration` lists the pairs to test."""

    mode: Literal["hard", "soft"] = "hard"
    """`"hard"` forbids intersections; `"soft"` is a half-Gaussian in the depth, for kernels that need a gradient."""
    yield_m: NonNegative = 0.03
    """[metres] allowed depth of an intersection."""
    soft_sd_m: Positive = 0.01
    """[metres] with `"soft"`: standard deviation of the depth beyond that."""


def _depths(
    body: Body, yield_m: Scalar, configuration: Configuration, depth_function: Callable[[Body, Transform], jax.Array] = penetration_depths
) -> jax.Array:
    T_world_part = Transform(*jax.lax.optimization_barrier(tuple(part_transforms(body, configuration))))
    return depth_function(widened(body, configuration), T_world_part) - yield_m


def _hard(body: Body, yield_m: Scalar, values: Variables, data: None) -> Scalar:
    del data
    # A step has no gradient, so do not trace one.
    return jnp.where(jnp.any(_depths(body, yield_m, jax.lax.stop_gradient(values[Variable(body.variable)])) > 0), -jnp.inf, 0.0)


def _excess(body: Body, yield_m: Scalar, values: Variables) -> Float[Array, "pair 1"]:
    return _depths(body, yield_m, values[Variable(body.variable)], smooth_penetration_depths)[:, None]


def _soft(soft_sd: Scalar, excess: Float[Array, "pair 1"], data: None) -> Float[Array, " pair"]:
    del data
    return -0.5 * (jnp.maximum(excess[:, 0], 0.0) / soft_sd) ** 2


@register("potential", "intersection", Options)
def build(name: str, options: Options, body: Body, **_: Any) -> Factor:
    """Build the factor for one body."""
    dtype = body.lengths.dtype
    yield_m, soft_sd = jnp.asarray(options.yield_m, dtype), jnp.asarray(options.soft_sd_m, dtype)
    hard = jax.tree_util.Partial(_hard, body, yield_m)
    soft = Composed(jax.tree_util.Partial(_excess, body, yield_m), jax.tree_util.Partial(_soft, soft_sd))
    potential = hard if options.mode == "hard" else soft
    return Factor(name=name, side="constraint", scope=(Variable(body.variable),), log_potential=potential)
