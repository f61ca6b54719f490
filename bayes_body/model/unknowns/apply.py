"""Unknowns put into a model: variables of the motion prior, and changed bodies and cameras in the factors. This is the only place that does so."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import jax
from jaxtyping import Array
from numpyro.distributions import Distribution

from bayes_body.base.shapes import Key, Scalar
from bayes_body.density.chart import ChartBeside
from bayes_body.density.factor import Composed, Factor, State, Transition, Variable, Variables, draw, nothing_carried, variables
from bayes_body.density.plate import Plate
from bayes_body.model.unknowns.unknown import Unknown, initial_values

type Unknowns = tuple[Unknown, ...]


def with_changes(unknowns: Unknowns, tree: Any, values: Variables) -> Any:
    """Return a pytree with the nodes changed that depend on the unknowns, one unknown after the other.

    Args:
        unknowns: those that the tree depends on.
        tree: a part of a factor.
        values: the variables of a state.
    """
    for term in unknowns:
        tree = _mapped(term.node, lambda node, term=term: term.change(node, values[Variable(term.name)], values), tree)
    return tree


def _mapped(kind: type, change: Any, tree: Any) -> Any:
    return jax.tree.map(lambda node: change(node) if isinstance(node, kind) else node, tree, is_leaf=lambda node: isinstance(node, kind))


def node_of[Node](factor: Factor, kind: type[Node]) -> Node | None:
    """Return the first node of a type in a factor, as it is before unknowns change it; None if there is none."""
    leaves = jax.tree.leaves(factor, is_leaf=lambda node: isinstance(node, kind))
    return next((leaf for leaf in leaves if isinstance(leaf, kind)), None)


# -- factors ----------------------------------------------------------------------------------------------------------------------------


def factor_with(factor: Factor, unknowns: Unknowns) -> Factor:
    """Return a factor that reads the unknowns on which it depends. If there are none, it is the same factor."""
    terms = tuple(term for term in unknowns if term.concerns(factor))
    if not terms:
        return factor
    for term in terms:
        factor = _mapped(term.node, term.prepare, factor)
    names = [name for term in terms for name in (term.name, *term.reads)]
    scope = tuple(dict.fromkeys([*factor.scope, *(Variable(name) for name in names)]))
    potential = factor.log_potential
    if isinstance(potential, Plate):
        potential = replace(potential, sizes=tuple(term.name for term in terms))
    elif isinstance(potential, Composed):
        local = tuple((Variable(term.name), term.moves) for term in terms if term.moves)
        potential = replace(potential, inner=jax.tree_util.Partial(_changed, terms, potential.inner), local=local)
    else:
        potential = jax.tree_util.Partial(_changed_with_data, terms, potential)
    simulate = None if factor.simulate is None else jax.tree_util.Partial(_changed_draw, terms, factor.simulate)
    curvature = None if factor.curvature is None else jax.tree_util.Partial(_changed_with_data, terms, factor.curvature)
    return replace(factor, scope=scope, log_potential=potential, simulate=simulate, curvature=curvature)


def _changed(terms: Unknowns, inner: Any, values: Variables) -> Any:
    return with_changes(terms, inner, values)(values)


def _changed_with_data(terms: Unknowns, function: Any, values: Variables, data: Any) -> Any:
    return with_changes(terms, function, values)(values, data)


def _changed_draw(terms: Unknowns, simulate: Any, key: Key, values: Variables) -> Any:
    return with_changes(terms, simulate, values)(key, values)


def settled_factor(factor: Factor, state: State) -> Factor:
    """Return a factor as it was before it read unknowns, with their values put in. Unknowns that the state cannot change are left at their mean.

    Args:
        factor: from `factor_with`.
        state: values of unknowns, by name.
    """
    potential = factor.log_potential
    if isinstance(potential, Plate):
        return _settled_plate(factor, potential, variables(state))
    function: Any = potential.inner if isinstance(potential, Composed) else potential
    if getattr(function, "func", None) not in (_changed, _changed_with_data):
        return factor
    values = variables(state)
    terms = tuple(term for term in function.args[0] if all(Variable(name) in values for name in (term.name, *term.reads)))

    def settled(changed: Any) -> Any:
        return None if changed is None else with_changes(terms, changed.args[1], values)

    composed = isinstance(potential, Composed)
    settled_potential = replace(potential, inner=settled(potential.inner), local=()) if composed else settled(potential)
    unread = {term.name for term in function.args[0]} | {name for term in function.args[0] for name in term.reads}
    scope = tuple(variable for variable in factor.scope if variable.name not in unread)
    return replace(factor, scope=scope, log_potential=settled_potential, simulate=settled(factor.simulate), curvature=settled(factor.curvature))


def _settled_plate(factor: Factor, plate: Plate, values: Variables) -> Factor:
    if not plate.sizes:
        return factor
    simulate: Any = factor.simulate
    settled_simulate = None if simulate is None else with_changes(simulate.args[0], simulate.args[1], values)
    return replace(factor, scope=(Variable(plate.variable),), log_potential=plate.settled(values), simulate=settled_simulate)


# -- the motion prior -------------------------------------------------------------------------------------------------------------------


def transition_with(transition: Transition, unknowns: Unknowns) -> Transition:
    """Return a motion prior with the unknowns as further variables; without any, the same one."""
    if not unknowns:
        return transition
    carries = getattr(transition.carry, "func", transition.carry) is not nothing_carried
    partial = jax.tree_util.Partial
    return replace(
        transition,
        conditional=partial(_conditional, unknowns, transition.conditional),
        perturbation=partial(_perturbation, unknowns, transition.perturbation),
        carry=partial(_carry, unknowns, transition.carry) if carries else transition.carry,
        begin=partial(_begin, unknowns, transition.begin),
        first=partial(_first, unknowns, transition.first),
        chart=None if transition.chart is None else partial(_chart, unknowns, transition.chart),
        explore=None if transition.explore is None else partial(_explore, unknowns, transition.explore),
        spaces=(*transition.spaces, *((term.name, term.space) for term in unknowns)),
    )


def _conditional(unknowns: Unknowns, conditional: Any, previous: State) -> dict[str, Distribution]:
    return {**conditional(previous), **{term.name: term.onward(previous[term.name]) for term in unknowns}}


def _perturbation(unknowns: Unknowns, perturbation: Any, state: State, scale: Scalar) -> dict[str, Distribution]:
    return {**perturbation(state, scale), **{term.name: term.noise_about(state[term.name], scale) for term in unknowns}}


def _carry(unknowns: Unknowns, carry: Any, previous: State, sampled: State) -> dict[str, Array]:
    return {**carry(previous, sampled), **{term.name: sampled[term.name] for term in unknowns}}


def _begin(unknowns: Unknowns, begin: Any, first: State) -> dict[str, Array]:
    return {**begin(first), **initial_values(unknowns)}


def _first(unknowns: Unknowns, first: Any, state: State) -> Mapping[str, Distribution]:
    return {**({} if first is None else first(state)), **{term.name: term.prior() for term in unknowns}}


def _chart(unknowns: Unknowns, chart: Any, previous: State) -> ChartBeside:
    return ChartBeside(tuple(term.name for term in unknowns), chart(previous))


def _explore(unknowns: Unknowns, explore: Any, key: Key, state: State, previous: State, scale: Scalar) -> dict[str, Array]:
    explore_key, noise_key = jax.random.split(key)
    noise = {term.name: term.noise_about(state[term.name], scale) for term in unknowns}
    return {**explore(explore_key, state, previous, scale), **draw(noise_key, noise)}
