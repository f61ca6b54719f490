"""Checks of a plugin's terms when they are used. For built-in terms, the type checker and the tests guarantee the same."""

import math
import re
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bayes_body.base.errors import input_error
from bayes_body.base.registry import Room
from bayes_body.density.factor import Data, Factor, State, Transition, Variables, variables
from bayes_body.model.plugins.blame import Own
from bayes_body.model.plugins.terms import shown
from bayes_body.model.unknowns.unknown import Unknown

# What each room's build function returns, in the user's terms.
MADE = {
    "likelihood": "a Factor",
    "potential": "a Factor",
    "dynamics": "a Transition",
    "unknown": "an Unknown",
    "observation": "a function of a frame",
    "kernel": "a function (key, particles, density)",
}


def checked_term(room: Room, term: Any, name: str, subject: str) -> Any:
    """Check what a build function returned, and return it.

    Args:
        room: the room of the term.
        term: what the build function returned.
        name: the name requested for the factor.
        subject: the name of the term in error messages.

    Raises:
        InputError: it has the wrong type, or a factor has a different name or the wrong side.
    """
    kind = {"likelihood": Factor, "potential": Factor, "dynamics": Transition, "unknown": Unknown}.get(room)
    if not (isinstance(term, kind) if kind else callable(term)):
        raise input_error(f"{subject}: its build function", f"returns {shown(term)}", MADE[room], "return one")
    if isinstance(term, Factor):
        _check_named(room, term, name, subject)
    return term


def _check_named(room: Room, factor: Factor, name: str, subject: str) -> None:
    if factor.name != name:
        raise input_error(subject, f"its factor is called '{factor.name}'", f"'{name}'", "pass on the name that the build function is given")
    sides = ("likelihood",) if room == "likelihood" else ("constraint", "prior")
    if factor.side not in sides:
        raise input_error(subject, f'its factor has the side "{factor.side}"', f'"{sides[0]}"', "correct the factor's side")


def check_factors(density: Any, state: State, terms: Mapping[str, str]) -> None:
    """Check that a user's own factors return one number, which at the first pose is finite or minus infinity.

    Args:
        density: the density of the first frame (`bayes_body.density.density.Density`).
        state: the first pose.
        terms: the user's own terms: their names, and their names in error messages. A second factor of a kind has a number after its name.

    Raises:
        InputError: a factor reads a variable that does not exist, or returns an array, something other than a number, NaN or infinity.
    """
    values = variables(state, density.ancestor(0))
    for factor in density.factors:
        subject = terms.get(factor.name) or terms.get(re.sub(r"_\d+$", "", factor.name))
        if subject:
            function = getattr(factor.log_potential, "func", None)
            subject = function.origin.describe(function) if isinstance(function, Own) else subject
            _check_scope(factor, values, subject)
            _check_value(factor, values, density.data, f"{subject}: its log-potential")


def _check_scope(factor: Factor, values: Variables, subject: str) -> None:
    absent = [variable for variable in factor.scope if variable not in values]
    if absent:
        names = ", ".join(repr(tuple(variable)) for variable in sorted(values))
        raise input_error(
            f"{subject}: its scope", f"has {tuple(absent[0])!r}", f"variables (name, offset) of the model: {names}", "correct the scope"
        )


def _check_value(factor: Factor, values: Variables, data: Data, subject: str) -> None:
    output = jax.eval_shape(factor, values, data)
    shape, dtype = getattr(output, "shape", None), getattr(output, "dtype", None)
    remedy = "return the sum of its terms"
    if shape is None or dtype is None:
        raise input_error(subject, f"returns {shown(output)}", "one number", remedy)
    if shape != ():
        raise input_error(subject, f"returns an array of shape {shape}", "one number, of shape ()", remedy)
    if not (jnp.issubdtype(dtype, jnp.floating) or jnp.issubdtype(dtype, jnp.integer)):
        raise input_error(subject, f"returns a number of type {dtype}", "a real number", remedy)
    value = float(jax.jit(factor)(values, data))
    if math.isnan(value) or value == math.inf:
        problem = f"is {'NaN' if math.isnan(value) else 'infinite'} at the first pose, with the data of the first frame"
        raise input_error(subject, problem, "a finite number, or minus infinity", "look for 0 / 0, the logarithm of 0, or missing data")


def check_transition(density: Any, state: State) -> None:
    """Check that a user's own motion prior draws states like the first one, with one finite log-density.

    Args:
        density: the density of the first frame (`bayes_body.density.density.Density`).
        state: the first state.

    Raises:
        InputError: it draws other variables, or arrays of other shapes, or its log-density is an array, NaN or infinite.
    """
    transition: Transition = density.transition
    function = getattr(transition.conditional, "func", None)
    if not isinstance(function, Own):
        return
    subject = function.origin.describe(function)
    ancestor, key = density.ancestor(0), jax.random.key(0)
    for name, distribution in transition.conditional(ancestor).items():
        if not (callable(getattr(distribution, "sample", None)) and callable(getattr(distribution, "log_prob", None))):
            raise input_error(subject, f"'{name}' is {shown(distribution)}", "a distribution of numpyro for each variable", "return one")
    drawn = jax.eval_shape(transition.sample, key, ancestor)
    forms, expected = ({name: tuple(np.shape(value)) for name, value in arrays.items()} for arrays in (drawn, state))
    if forms != expected:
        raise input_error(
            subject, f"draws states with {_listed(forms)}", f"{_listed(expected)}, as the first state has", "draw or carry each of them"
        )
    log_density = jax.eval_shape(transition.log_density, drawn, ancestor)
    if log_density.shape != ():
        remedy = "make the last axis an event, with `.to_event(1)`"
        raise input_error(f"{subject}: its log-density", f"has the shape {log_density.shape}", "one number, of shape ()", remedy)
    sample, value = jax.jit(_drawn)(transition, key, ancestor)
    broken = [name for name, array in sample.items() if not np.isfinite(np.asarray(array, float)).all()]
    if broken or not math.isfinite(value):
        problem = f"'{broken[0]}' is not finite in a state that it draws" if broken else f"its log-density of a state that it draws is {float(value)}"
        raise input_error(subject, problem, "finite numbers", "look for deviations that are 0, and for limits that the first pose does not keep")


def _drawn(transition: Transition, key: Any, ancestor: State) -> tuple[State, Any]:
    sample = transition.sample(key, ancestor)
    return sample, transition.log_density(sample, ancestor)


def _listed(forms: Mapping[str, tuple[int, ...]]) -> str:
    return ", ".join(f"`{name}` {shape}" for name, shape in sorted(forms.items()))
