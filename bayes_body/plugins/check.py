"""Checks of a plugin's terms when they are used. For built-in terms, the type checker and the tests guarantee the same."""

import math
import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp

from bayes_body.density.factor import Data, Factor, State, Transition, Variables, variables
from bayes_body.errors import input_error
from bayes_body.registry import Room

# What each room's build function returns, in the user's terms.
MADE = {
    "likelihood": "a Factor",
    "potential": "a Factor",
    "dynamics": "a Transition",
    "observation": "a function of a frame",
    "kernel": "a function (key, particles, density)",
}


def checked_term(room: Room, term: Any, name: str, where: str) -> Any:
    """Check what a build function returned, and return it in the form that its room requires.

    Args:
        room: the room of the term.
        term: what the build function returned.
        name: the name requested for the factor.
        where: the name of the term in error messages.

    Raises:
        InputError: it has the wrong type, or a factor has a different name or the wrong side.
    """
    kind = {"likelihood": Factor, "potential": Factor, "dynamics": Transition}.get(room)
    if not (isinstance(term, kind) if kind else callable(term)):
        raise input_error(f"{where}: its build function", f"returns {_shown(term)}", MADE[room], "return one")
    return _checked_factor(room, term, name, where) if isinstance(term, Factor) else term


def _checked_factor(room: Room, factor: Factor, name: str, where: str) -> Factor:
    if factor.name != name:
        raise input_error(where, f"its factor is called '{factor.name}'", f"'{name}'", "pass on the name that the build function is given")
    sides = ("likelihood",) if room == "likelihood" else ("constraint", "prior")
    if factor.side not in sides:
        raise input_error(where, f'its factor has the side "{factor.side}"', f'"{sides[0]}"', "correct the factor's side")
    functions = {key: _leafless(getattr(factor, key)) for key in ("log_potential", "simulate", "curvature")}
    return replace(factor, **functions)


def _leafless(function: Any) -> Any:
    """Wrap a bare function, which would otherwise be a leaf of the model. Leaves must be arrays."""
    bare = callable(function) and jax.tree.leaves(function) == [function]
    return jax.tree_util.Partial(function) if bare else function


def check_factors(density: Any, state: State, own: Mapping[str, str]) -> None:
    """Check that a user's own factors return one number, which at the first pose is finite or minus infinity.

    Args:
        density: the density of the first frame (`bayes_body.density.density.Density`).
        state: the first pose.
        own: the user's own terms: their names, and their names in error messages. A second factor of a kind has a number after its name.

    Raises:
        InputError: a factor reads a variable that does not exist, or returns an array, something other than a number, NaN or infinity.
    """
    values = variables(state, density.ancestor(0))
    for factor in density.factors:
        where = own.get(factor.name) or own.get(re.sub(r"_\d+$", "", factor.name))
        if where:
            _check_scope(factor, values, where)
            _check_value(factor, values, density.data, f"{where}: its log-potential")


def _check_scope(factor: Factor, values: Variables, where: str) -> None:
    absent = [variable for variable in factor.scope if variable not in values]
    if absent:
        known = ", ".join(repr(tuple(variable)) for variable in sorted(values))
        raise input_error(f"{where}: its scope", f"has {tuple(absent[0])!r}", f"variables (name, offset) of the model: {known}", "correct the scope")


def _check_value(factor: Factor, values: Variables, data: Data, where: str) -> None:
    found = jax.eval_shape(factor, values, data)
    shape, dtype = getattr(found, "shape", None), getattr(found, "dtype", None)
    remedy = "return the sum of its terms"
    if shape is None or dtype is None:
        raise input_error(where, f"returns {_shown(found)}", "one number", remedy)
    if shape != ():
        raise input_error(where, f"returns an array of shape {shape}", "one number, of shape ()", remedy)
    if not (jnp.issubdtype(dtype, jnp.floating) or jnp.issubdtype(dtype, jnp.integer)):
        raise input_error(where, f"returns a number of type {dtype}", "a real number", remedy)
    value = float(jax.jit(factor)(values, data))
    if math.isnan(value) or value == math.inf:
        found = f"is {'NaN' if math.isnan(value) else 'infinite'} at the first pose, with the data of the first frame"
        raise input_error(where, found, "a finite number, or minus infinity", "look for 0 / 0, the logarithm of 0, or missing data")


def _shown(value: Any) -> str:
    return "nothing" if value is None else type(value).__name__
