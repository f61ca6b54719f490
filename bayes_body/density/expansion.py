r"""A density's terms about a point: value, slope and a precision without negative eigenvalues, for searches of a mode.

The terms are all factors of a frame; the motion prior is left out. Three kinds of factors have a precision:

- `Composed` factors, $\sum_r f_r(y_r)$ with rows $y = g(x)$: the generalised Gauss-Newton matrix (Schraudolph 2002)
  $J^T M J$, with $J = \partial g / \partial x$ and the blocks $M_r = -\partial^2 f_r / \partial y_r^2$, whose negative eigenvalues are set to 0. So
  a wrong keypoint of a heavy-tailed density has no precision.
- factors with a `curvature`, which is over variables: $S^T C S$ with $S$ the derivative of the variables.
- all others: minus their second derivatives, by differences of gradients over `STEP`, with negative eigenvalues set to 0. Of interpolated images,
  exact second derivatives would tell only about the nearest pixels.
"""

from collections.abc import Callable
from functools import partial, reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bayes_body.base.shapes import Scalar
from bayes_body.density.density import Density
from bayes_body.density.factor import Composed, Factor, State, variables
from bayes_body.density.jacobian import rows_and_jacobians

# Added to the square of half the distance between two eigenvalues, so that its root has a slope.
TINY = 1e-20
# Half of the distance over which gradients are compared, in units of the coordinates. Those of a search for a mode have the prediction's deviation 1.
STEP = 0.05
# Gradients that are computed at once.
BATCH = 16


class Expansion(NamedTuple):
    """A log-density near a point x: `value + gradient · d - d · precision · d / 2`.

    Attributes:
        value: the log-density at x, nats.
        gradient: its gradient.
        precision: symmetric, without negative eigenvalues.
    """

    value: Scalar
    gradient: Float[Array, " dof"]
    precision: Float[Array, "dof dof"]


def expand(density: Density, state_of: Callable[[Float[Array, " dof"]], State], x: Float[Array, " dof"]) -> Expansion:
    """Return the expansion of the sum of a density's factors.

    Args:
        density: the density of a frame. No factor may read the previous frame.
        state_of: the state at a point.
        x: the point.
    """
    composed = [factor for factor in density.factors if isinstance(factor.log_potential, Composed)]
    others = [factor for factor in density.factors if not isinstance(factor.log_potential, Composed)]
    pieces = [_of_composed(composed, density, state_of, x)] if composed else []
    for factor in others:
        expansion = _of_any if factor.curvature is None else _of_curved
        pieces.append(expansion(factor, density, state_of, x))
    return _summed(pieces)


def _summed(pieces: list[Expansion]) -> Expansion:
    return reduce(lambda one, other: Expansion(*map(jnp.add, one, other)), pieces)


def _of_composed(factors: list[Factor], density: Density, state_of: Callable[[Array], State], x: Array) -> Expansion:
    """Return the expansion of all composed factors. Their inner functions are linearised together, as they share the kinematics."""
    potentials = [potential for factor in factors if isinstance(potential := factor.log_potential, Composed)]
    pieces = []
    for factor, potential, y, jacobian in zip(factors, potentials, *rows_and_jacobians(factors, state_of, x), strict=True):
        outer = partial(_outer, potential, density.data.get(factor.name))
        value, slope = jax.value_and_grad(outer)(y)
        J, M = jacobian.reshape(-1, *jacobian.shape[-2:]), _row_blocks(outer, y)
        gradient = jnp.einsum("ria,ri->a", J, slope.reshape(J.shape[:2]))
        pieces.append(Expansion(value, gradient, jnp.einsum("ria,rib->ab", J, jnp.einsum("rij,rjb->rib", M, J))))
    return _summed(pieces)


def _outer(potential: Composed, data: Any, rows: Array) -> Scalar:
    return jnp.sum(potential.outer(rows, data))


def _row_blocks(outer: Callable[[Array], Scalar], rows: Float[Array, "*row entry"]) -> Float[Array, "rows entry entry"]:
    """Return minus the second derivatives of each row's term. Rows are independent: one directional derivative for each entry gives all blocks."""
    directions = [jnp.zeros_like(rows).at[..., entry].set(1.0) for entry in range(rows.shape[-1])]
    blocks = jnp.stack([-jax.jvp(jax.grad(outer), (rows,), (direction,))[1] for direction in directions], axis=-1)
    return without_negative(blocks.reshape(-1, *blocks.shape[-2:]))


def without_negative(matrices: Float[Array, "*batch entry entry"]) -> Float[Array, "*batch entry entry"]:
    """Return symmetric matrices with their negative eigenvalues set to 0; a closed form up to two entries."""
    size = matrices.shape[-1]
    if size == 1:
        return jnp.maximum(matrices, 0.0)
    if size > 2:
        values, vectors = jnp.linalg.eigh(matrices)
        return (vectors * jnp.maximum(values, 0.0)[..., None, :]) @ jnp.swapaxes(vectors, -1, -2)
    a, b, c = matrices[..., 0, 0], matrices[..., 1, 1], matrices[..., 0, 1]
    mean, half = 0.5 * (a + b), jnp.sqrt((0.5 * (a - b)) ** 2 + c * c + TINY)
    low, high = jnp.maximum(mean - half, 0.0), jnp.maximum(mean + half, 0.0)
    # The matrix is mean I + half U, where U has the eigenvalues -1 and 1.
    identity = jnp.eye(2, dtype=matrices.dtype)
    unit = (matrices - mean[..., None, None] * identity) / half[..., None, None]
    return 0.5 * ((low + high)[..., None, None] * identity + (high - low)[..., None, None] * unit)


def _of_curved(factor: Factor, density: Density, state_of: Callable[[Array], State], x: Array) -> Expansion:
    """Return the expansion of a factor with a curvature over variables."""
    value, gradient = jax.value_and_grad(lambda x: factor(variables(state_of(x)), density.data))(x)
    assert factor.curvature is not None
    values = variables(state_of(x))
    by_variable = factor.curvature({v: values[v] for v in factor.scope}, density.data.get(factor.name))
    slopes = jax.jacfwd(lambda x: {name: state_of(x)[name].ravel() for name in by_variable})(x)
    return Expansion(
        value, gradient, sum((slopes[name].T @ C @ slopes[name] for name, C in by_variable.items()), jnp.zeros((x.shape[0],) * 2, x.dtype))
    )


def _of_any(factor: Factor, density: Density, state_of: Callable[[Array], State], x: Array) -> Expansion:
    """Return the expansion of a factor that has a gradient and nothing else."""
    log_potential = jax.value_and_grad(lambda x: factor(variables(state_of(x)), density.data))
    size = x.shape[0]
    # The point itself and its neighbours in one loop, so that the program holds the factor once.
    places = jnp.concatenate([jnp.zeros((1, size), x.dtype), STEP * jnp.eye(size, dtype=x.dtype), -STEP * jnp.eye(size, dtype=x.dtype)])
    values, gradients = jax.lax.map(lambda step: log_potential(x + step), places, batch_size=BATCH)
    second = (gradients[1 : size + 1] - gradients[size + 1 :]) / (2 * STEP)
    return Expansion(values[0], gradients[0], without_negative(-0.5 * (second + second.T)))
