"""Estimate how much memory the work of one particle takes, from the shapes in its program. Nothing is compiled.

The estimate is the largest number of bytes that are live at once if the operations run in the order in which they were traced. XLA fuses operations,
so it usually needs less.
"""

from collections.abc import Callable, Iterator
from typing import Any

import jax
from jax.extend.core import Jaxpr, JaxprEqn, Literal, Var


def work_bytes(function: Callable[..., Any], particles: Any, shared: Any) -> int:
    """Return the memory that one particle needs while the function computes it, bytes.

    Args:
        function: `(particle, shared) -> pytree`, for one particle.
        particles: pytree whose leaves have a leading particle axis.
        shared: an argument that is the same for all particles. What depends on it alone is not counted.
    """
    particle = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), particles)
    jaxpr = jax.make_jaxpr(function)(particle, shared).jaxpr
    return _peak(jaxpr, set(jaxpr.invars[: len(jax.tree.leaves(particle))]))


def _peak(jaxpr: Jaxpr, varying: set[Var]) -> int:
    """Return the most bytes that are live at once, of the variables that depend on `varying` ones. Arguments and results stay live."""
    live = sum(map(_bytes, varying))
    peak, last_use = live, _last_uses(jaxpr)
    varying = set(varying)
    for number, equation in enumerate(jaxpr.eqns):
        inputs = {atom for atom in equation.invars if not isinstance(atom, Literal)}
        if not inputs & varying:
            continue
        varying |= set(equation.outvars)
        live += sum(map(_bytes, equation.outvars))
        peak = max(peak, live + max((_peak(inner, _arguments(equation, inner, varying)) for inner in _inner(equation)), default=0))
        finished = {var for var in (inputs | set(equation.outvars)) & varying if last_use.get(var, number) == number}
        live -= sum(map(_bytes, finished))
    return peak


def _last_uses(jaxpr: Jaxpr) -> dict[Var, int]:
    """Return the number of the last equation that reads each variable; arguments and results are read after all."""
    uses = {atom: number for number, equation in enumerate(jaxpr.eqns) for atom in equation.invars if not isinstance(atom, Literal)}
    never_freed = [*jaxpr.invars, *(atom for atom in jaxpr.outvars if not isinstance(atom, Literal))]
    return uses | dict.fromkeys(never_freed, len(jaxpr.eqns))


def _inner(equation: JaxprEqn) -> Iterator[Jaxpr]:
    """Yield the programs within an operation: the body of a loop, the branches of a condition, a function that is called."""
    for parameter in equation.params.values():
        for value in parameter if isinstance(parameter, tuple | list) else (parameter,):
            # A closed program has its constants beside it.
            program = getattr(value, "jaxpr", value)
            if isinstance(program, Jaxpr):
                yield program


def _arguments(equation: JaxprEqn, inner: Jaxpr, varying: set[Var]) -> set[Var]:
    """Return the arguments of a program within an operation that depend on `varying` variables."""
    # Operations with more operands, such as the index of a branch, have them first.
    operands = equation.invars[len(equation.invars) - len(inner.invars) :]
    dependent = {argument for argument, atom in zip(inner.invars, operands, strict=True) if not isinstance(atom, Literal) and atom in varying}
    # What a loop carries depends on them after the first turn.
    constants = {"scan": equation.params.get("num_consts", 0), "while": len(inner.invars) - len(equation.outvars)}.get(equation.primitive.name)
    carried = len(equation.outvars) if equation.primitive.name == "while" else equation.params.get("num_carry", 0)
    return dependent if constants is None else dependent | set(inner.invars[constants : constants + carried])


def _bytes(var: Any) -> int:
    return var.aval.size * var.aval.dtype.itemsize if hasattr(var.aval, "dtype") else 0
