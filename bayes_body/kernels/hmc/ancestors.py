"""Chains on the extended view, for likelihoods that compare a state with its own past, such as image motion.

The marginal view would evaluate the images once for each ancestor. A chain has one ancestor instead, which a Gibbs step redraws before each
trajectory.
"""

from collections.abc import Callable

import jax
from jaxtyping import Array, Int

from bayes_body.base.shapes import Index, Key, Scalar
from bayes_body.density.density import Density, Unconstrained
from bayes_body.density.extended import extended
from bayes_body.density.factor import State
from bayes_body.kernels.hmc.hamiltonian import WithAncestor
from bayes_body.kernels.hmc.starts import Start


def compares_frames(density: Density) -> bool:
    """Return whether a likelihood depends on the previous frame."""
    return any(factor.reads_previous and factor.side == "likelihood" for factor in density.factors)


def with_ancestor(start: Start, density: Density, candidates: int) -> WithAncestor:
    """Return the extended view as a target, beginning with the ancestor that a chain's start was predicted from.

    Args:
        start: the start of the chain.
        density: the density of the frame.
        candidates: the number of ancestors among which a chain redraws its own, including the current one.
    """
    view = extended(density)

    def redraw(key: Key, ancestor: Index, position: State) -> Index:
        return view.choose_ancestor(key, ancestor, position, 1.0, candidates)

    def conditional(ancestor: Index) -> Callable[[State], Scalar]:
        return lambda position: view.log_density(ancestor, position)[0]

    return WithAncestor(start.ancestor, conditional, redraw, candidates)


def whole_states(draws: State, ancestors: Int[Array, " draw"], target: Unconstrained) -> State:
    """Return the whole states of draws whose ancestors are known, along a leading axis."""
    transition = target.density.transition

    def whole(position: State, ancestor: Index) -> State:
        return transition.carry(target.density.ancestor(ancestor), target.constrain(position))

    return jax.vmap(whole)(draws, ancestors)
