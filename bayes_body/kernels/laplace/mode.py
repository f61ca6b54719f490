r"""The mode of a frame's posterior in the Gaussian view, by the method of Levenberg and Marquardt.

In whitened coordinates $u = m + R z$ of the prediction $\mathcal N(m, R R^T)$, the log-density is
$f(z) = -\tfrac12 |z|^2 + \log C + \log \psi + \log L$. The precision is $A(z) = I + R^T H R$, with the precision H of the factors
(density/expansion.py). As A is at least I, no step is singular, whatever the cameras miss. A step solves $(A + \lambda I)\, d = \nabla f$. It is
undamped ($\lambda = 0$) until one makes f smaller.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from bayes_body.base.shapes import Scalar
from bayes_body.density.expansion import Expansion, expand
from bayes_body.density.gaussian_view import GaussianView

# The search ends when a step promises less than this, nats.
TOLERANCE = 1e-2
# A step may lower the log-density by this much, nats: the rounding of a sum over hundreds of keypoints in float32.
ROUNDING = 1e-3
# Factors of the damping after a step that is taken and after one that is refused, and the least damping after the latter.
EASED, RAISED, LEAST = 0.1, 10.0, 1.0


class Mode(NamedTuple):
    """A mode, and the Gaussian that touches the log-density there.

    Attributes:
        centre: the mode, in whitened coordinates.
        height: the log-density there, without the constant of the prediction.
        precision: minus its second derivatives there, at least the identity.
        steps: number of steps of the search.
    """

    centre: Float[Array, " dof"]
    height: Scalar
    precision: Float[Array, "dof dof"]
    steps: Int[Array, ""]


class _Search(NamedTuple):
    """The state of a search: a point, the expansion there, the damping, the number of steps, and the gain that the last step promised."""

    point: Float[Array, " dof"]
    expansion: Expansion
    damping: Scalar
    steps: Int[Array, ""]
    promise: Scalar


def find_mode(view: GaussianView, start: Float[Array, " dof"], most_steps: int | Int[Array, ""]) -> Mode:
    """Return the mode that is reached from a start; with `most_steps` = 0 the start, with a height of -∞.

    Args:
        view: the Gaussian view of the frame.
        start: whitened coordinates.
        most_steps: largest number of steps.
    """
    identity = jnp.eye(start.shape[0], dtype=start.dtype)

    def expansion_at(z: Float[Array, " dof"]) -> Expansion:
        value, gradient, precision = expand(view.density, view.state_at, z)
        return Expansion(value - 0.5 * jnp.sum(z * z), gradient - z, precision + identity)

    def step(search: _Search) -> _Search:
        current = search.expansion
        root = jax.scipy.linalg.cho_factor(current.precision + search.damping * identity, lower=True)
        move = jax.scipy.linalg.cho_solve(root, current.gradient)
        proposed = expansion_at(search.point + move)
        # False for NaN, too.
        is_better = proposed.value >= current.value - ROUNDING
        point, expansion = jax.tree.map(lambda new, old: jnp.where(is_better, new, old), (search.point + move, proposed), (search.point, current))
        damping = jnp.where(is_better, EASED * search.damping, jnp.maximum(RAISED * search.damping, LEAST))
        promise = jnp.where(is_better, 0.5 * jnp.sum(move * current.gradient), jnp.inf)
        return _Search(point, expansion, damping, search.steps + 1, promise)

    # Nothing is known at the start. The first step stays there, and expands the density: so the program holds the expansion once.
    without_density = Expansion(jnp.array(-jnp.inf, start.dtype), jnp.zeros_like(start), identity)
    first = _Search(start, without_density, jnp.zeros((), start.dtype), jnp.zeros((), jnp.int32), jnp.array(jnp.inf, start.dtype))
    last = jax.lax.while_loop(lambda s: (s.steps < most_steps) & ((s.promise > TOLERANCE) | (s.steps < 2)), step, first)
    return Mode(last.point, last.expansion.value, last.expansion.precision, last.steps)
