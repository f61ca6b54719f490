r"""The rows of composed factors near a point, with few pushes through the linearised kinematics.

A Jacobian $\partial y / \partial x$ takes one push for each coordinate. But a camera's motion changes this camera's rows alone, and the offset of a
keypoint this marker's rows. Entries of the state that share no row share a push, and the mask of their rows takes the result apart (Curtis, Powell &
Reid 1974): six pushes for all cameras, and three for all offsets. In whitened coordinates nearly all rows depend on all coordinates. So with such
entries, the Jacobian is taken by the state's entries s, and

$$\frac{\partial y}{\partial x} = \frac{\partial y}{\partial s} \frac{\partial s}{\partial x}.$$
"""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from bayes_body.density.factor import Composed, Factor, Numbered, State, Variable, variables


def rows_and_jacobians(
    factors: Sequence[Factor], state_of: Callable[[Float[Array, " dof"]], State], x: Float[Array, " dof"]
) -> tuple[list[Float[Array, "*row entry"]], list[Float[Array, "*row entry dof"]]]:
    """Return the rows of composed factors and their Jacobians. The factors are linearised together, as they share the kinematics.

    Args:
        factors: composed factors that read one frame.
        state_of: the state at a point.
        x: the point.
    """
    potentials = [potential for factor in factors if isinstance(potential := factor.log_potential, Composed)]
    read = tuple(dict.fromkeys(variable for factor in factors for variable in factor.scope))

    def entries_at(x: Array) -> dict[Variable, Array]:
        values = variables(state_of(x))
        return {variable: values[variable] for variable in read}

    def rows_of(values: dict[Variable, Array]) -> list[Array]:
        return [potential.inner({v: values[v] for v in factor.scope}) for factor, potential in zip(factors, potentials, strict=True)]

    local = _local(factors, potentials)
    if not local:
        rows, push = jax.linearize(lambda x: rows_of(entries_at(x)), x)
        return rows, jax.vmap(push, out_axes=-1)(jnp.eye(x.shape[0], dtype=x.dtype))
    values, push_values = jax.linearize(entries_at, x)
    slopes = jax.vmap(lambda direction: ravel_pytree(push_values(direction))[0], out_axes=-1)(jnp.eye(x.shape[0], dtype=x.dtype))
    # In the order in which the entries are joined. The entries of other variables move everything.
    moves = [local.get(variable, Numbered("", (0,) * values[variable].size)) for variable in sorted(values)]
    pushes = _pushes(moves)
    entries, unravel = ravel_pytree(values)
    rows, push = jax.linearize(lambda entries: rows_of(unravel(entries)), entries)
    seeds = np.arange(pushes.max() + 1)[:, None] == pushes
    shared = jax.vmap(push, out_axes=-1)(jnp.asarray(seeds, x.dtype))
    by_entry = [jnp.where(_mask(potential.axes, moves), columns[..., pushes], 0.0) for potential, columns in zip(potentials, shared, strict=True)]
    return rows, [jnp.matmul(jacobian, slopes, precision="highest") for jacobian in by_entry]


def _local(factors: Sequence[Factor], potentials: Sequence[Composed]) -> dict[Variable, Numbered]:
    """Return the variables of which each entry changes rows of one camera or marker alone, in all factors that read them."""
    local = {variable: moves for potential in potentials for variable, moves in potential.local}

    def is_local(variable: Variable, moves: Numbered) -> bool:
        readers = [potential for factor, potential in zip(factors, potentials, strict=True) if variable in factor.scope]
        return all((variable, moves) in potential.local and moves.kind in [axis.kind for axis in potential.axes] for potential in readers)

    return {variable: moves for variable, moves in local.items() if is_local(variable, moves)}


def _pushes(moves: Sequence[Numbered]) -> Int[np.ndarray, " entry"]:
    """Return the push in which each entry takes part. No two entries of one camera or marker, or of two variables, share a push."""
    pushes, first = [], 0
    for _, numbers in moves:
        ranks = np.array([numbers[:entry].count(number) for entry, number in enumerate(numbers)])
        pushes.append(first + ranks)
        first += ranks.max() + 1
    return np.concatenate(pushes)


def _mask(axes: Sequence[Numbered], moves: Sequence[Numbered]) -> Bool[np.ndarray, "*row 1 entry"]:
    """Return which rows each entry may change; without `axes` all."""
    mask = np.ones((1, sum(len(numbers) for _, numbers in moves)), bool)
    for kind, places in reversed(axes):
        belongs = np.concatenate([np.equal.outer(places, numbers) | (moved != kind) for moved, numbers in moves], axis=1)
        mask = belongs.reshape(len(places), *(1,) * (mask.ndim - 1), -1) & mask
    return mask
