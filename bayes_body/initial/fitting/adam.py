r"""Adam (Kingma & Ba 2015) with a decaying learning rate; the fits of first poses, motions and outlines use it (docs/decisions/18_least_squares.md).

Step k of n has progress $p = k / (n - 1)$ and learning rate $\tfrac12 r (1 + \cos \pi p)$, which ends at 0.
"""

from collections.abc import Callable
from typing import Any, cast

import jax
import jax.numpy as jnp
import optax

from bayes_body.base.shapes import Scalar


def minimise[Parameters, Info](
    slope: Callable[[Parameters, Scalar], tuple[Parameters, Info]], start: Parameters, rate: float | Scalar, steps: int
) -> tuple[Parameters, Info]:
    """Return the parameters after all steps, and the extra output of the last call of `slope`.

    The last step has rate 0, so that output belongs to the returned parameters.

    Args:
        slope: maps the parameters and the progress (0 to 1) to the gradient and any extra output.
        start: any pytree of arrays of one dtype.
        rate: learning rate of the first step, in the parameters' unit.
        steps: number of steps; each calls `slope` once.
    """
    adam, at_start = optax.scale_by_adam(b1=0.9, b2=0.99), cast(Any, start)
    dtype = jax.tree.leaves(start)[0].dtype

    def step(carry: tuple[Any, Any, Any], progress: Scalar) -> tuple[tuple[Any, Any, Any], None]:
        parameters, state, _ = carry
        gradient, info = slope(parameters, progress)
        direction, state = adam.update(cast(Any, gradient), state)
        pace = -0.5 * rate * (1 + jnp.cos(jnp.pi * progress))
        return (optax.apply_updates(parameters, optax.tree.scale(pace, direction)), state, info), None

    _, shape = jax.eval_shape(slope, start, jnp.ones((), dtype))
    nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shape)
    (parameters, _, info), _ = jax.lax.scan(step, (at_start, adam.init(at_start), nothing), jnp.linspace(0, 1, steps, dtype=dtype))
    return parameters, info
