"""A plugin's terms as the program uses them: each of its functions wrapped (`Own`), and what it returns checked at every call."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bayes_body.base.errors import input_error
from bayes_body.base.shapes import Key
from bayes_body.density.density import Density
from bayes_body.density.factor import Factor, Particles, Transition
from bayes_body.density.kernel import FilterInfo
from bayes_body.model.plugins.blame import Origin, Own, first_line
from bayes_body.model.unknowns.unknown import Unknown

# Functions of a transition that return variables by name.
BY_NAME = ("conditional", "perturbation", "carry", "begin", "first", "derive", "explore")
# Dimensions of a kernel's diagnostics: one number for each particle, one, or one for each stage.
INFO = {
    "ancestors": "particle",
    "ess": "",
    "survival_rate": "stage",
    "inverse_temperatures": "stage",
    "log_evidence": "",
    "lost": "",
    "acceptance_rate": "stage",
    "evaluations": "",
}


def owned(origin: Origin, term: Any) -> Any:
    """Return a term with its plugin's functions wrapped. The term has the type that its room requires."""
    if isinstance(term, Factor):
        functions = {"log_potential": _array, "simulate": _arrays, "curvature": _arrays}
        return replace(term, **{name: _wrapped(origin, getattr(term, name), check) for name, check in functions.items()})
    if isinstance(term, Transition):
        checks = dict.fromkeys(BY_NAME, _by_name) | {"chart": None}
        return replace(term, **{name: _wrapped(origin, getattr(term, name), check) for name, check in checks.items()})
    if isinstance(term, Unknown):
        return replace(term, change=_wrapped(origin, term.change, None))
    return OwnKernel(origin, term) if origin.room == "kernel" else OwnObserver(origin, term)


def _wrapped(origin: Origin, function: Any, check: Callable[[str, Any], None] | None) -> Any:
    """Return a function as a pytree without leaves of other kinds than arrays; wrapped, if the plugin defines it."""
    if function is None:
        return None
    if callable(function) and jax.tree.leaves(function) == [function]:
        # A bare function would be a leaf of the model. Leaves must be arrays.
        function = jax.tree_util.Partial(function)
    if isinstance(function, jax.tree_util.Partial) and first_line(origin.path, function.func):
        return jax.tree_util.Partial(Own(origin, function.func, check), *function.args, **function.keywords)
    return function


def _by_name(subject: str, output: Any) -> None:
    if not isinstance(output, Mapping):
        raise input_error(subject, f"returns {shown(output)}", "a mapping from names of variables", "return a dict")


def _array(subject: str, output: Any) -> None:
    # What an array must be like is said with the first frame's data (model/plugins/check.py).
    if output is not None:
        _arrays(subject, output)


def _arrays(subject: str, output: Any) -> None:
    """Refuse what a compiled program cannot take."""
    for leaf in jax.tree.leaves(output):
        kind = np.dtype(leaf.dtype).kind if hasattr(leaf, "dtype") and not jnp.issubdtype(leaf.dtype, jax.dtypes.extended) else "f"
        if kind not in "biufcV" or not (hasattr(leaf, "shape") or isinstance(leaf, int | float | complex)):
            raise input_error(subject, f"returns {shown(leaf)}", "arrays of numbers", "convert it, or leave it out")


@dataclass(frozen=True, eq=False)
class OwnObserver(Own):
    """An observation of a plugin: its arrays must have the same names, shapes and types in every frame."""

    forms: list[Any] = field(default_factory=list)

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        """Return the arrays of a frame.

        Raises:
            InputError: the function fails, or its arrays are others than in the first frame.
        """
        output, subject = super().__call__(*arguments, **named), self.origin.describe(self.function)
        _arrays(subject, output)
        leaves, tree = jax.tree.flatten(output)
        form = tree, tuple((np.shape(leaf), np.asarray(leaf).dtype) for leaf in leaves)
        self.forms[:] = self.forms or [form]
        if form != self.forms[0]:
            first_shapes, shapes = (", ".join(f"{dtype}{list(shape)}" for shape, dtype in layout[1]) or "none" for layout in (self.forms[0], form))
            problem = f"returns arrays of the shapes {shapes}, and returned {first_shapes} before"
            raise input_error(subject, problem, "the same in every frame", "fill what is missing with zeros or NaN")
        return output


@dataclass(frozen=True)
class OwnKernel(Own):
    """A kernel of a plugin: it returns as many particles, in the same form, and all diagnostics."""

    def __call__(self, key: Key, particles: Particles, density: Density) -> tuple[Particles, FilterInfo]:
        """Filter one frame.

        Raises:
            InputError: the function fails, or what it returns has another form.
        """
        output, subject = super().__call__(key, particles, density), self.origin.describe(self.function)
        expected = "a pair (bb.Particles, bb.FilterInfo)"
        if not (isinstance(output, tuple) and len(output) == 2 and isinstance(output[0], Particles) and isinstance(output[1], FilterInfo)):
            shown_output = f"({', '.join(shown(element) for element in output)})" if type(output) is tuple else shown(output)
            raise input_error(subject, f"returns {shown_output}", expected, "return the particles of this frame, and their diagnostics")
        _check_particles(subject, output[0], particles)
        _check_info(subject, output[1], particles.log_weights.shape[0])
        return output

    def check_values(self, particles: Particles, frame: int) -> None:
        """Refuse a frame's particles if a number among them or a log-weight is not one.

        Raises:
            InputError: it is NaN, or all log-weights are -∞.
        """
        subject, weights = self.origin.describe(self.function), np.asarray(particles.log_weights)
        broken = [name for name, values in particles.states.items() if np.isnan(np.asarray(values, float)).any()]
        if np.isnan(weights).any() or not (weights > -np.inf).any():
            problem = f"log-weights of frame {frame} are {'NaN' if np.isnan(weights).any() else 'all minus infinity'}"
            raise input_error(subject, problem, "normalised log-weights", "where no particle explains the frame, return equal ones and set `lost`")
        if broken:
            raise input_error(subject, f"'{broken[0]}' is NaN in some particles of frame {frame}", "numbers", "give such particles no weight")


def check_result(kernel: Any, particles: Particles, frame: int) -> None:
    """Check the particles of a frame that a plugin's kernel computed; other kernels are left alone.

    Raises:
        InputError: a number is NaN.
    """
    if isinstance(kernel, OwnKernel):
        kernel.check_values(particles, frame)


def _check_particles(subject: str, particles: Particles, previous: Particles) -> None:
    forms = [
        {"log_weights": population.log_weights, **population.states} if isinstance(population.states, Mapping) else {}
        for population in (particles, previous)
    ]
    if set(forms[0]) != set(forms[1]):
        names, expected = (", ".join(sorted(form)) or "nothing" for form in forms)
        raise input_error(subject, f"particles with {names}", f"{expected}, as those that it is given", "return every variable of the state")
    for name, values in forms[0].items():
        ancestor_values = forms[1][name]
        form, expected = (f"{getattr(array, 'dtype', type(array).__name__)}{list(np.shape(array))}" for array in (values, ancestor_values))
        if form != expected:
            raise input_error(
                subject, f"`{name}` of the particles is {form}", f"{expected}, as it is given", "return as many particles, of that type"
            )


def _check_info(subject: str, info: FilterInfo, count: int) -> None:
    for name, dims in INFO.items():
        shape = np.shape(getattr(info, name))
        right = {"": shape == (), "particle": shape == (count,), "stage": len(shape) == 1}[dims]
        if not right:
            expected = {"": "one number, of shape ()", "particle": f"one for each particle, ({count},)", "stage": "one for each stage, (stage,)"}[
                dims
            ]
            raise input_error(subject, f"`{name}` of its bb.FilterInfo has the shape {shape}", expected, "see the fields of bb.FilterInfo")


def shown(value: Any) -> str:
    """Return the type of a value in words."""
    return "nothing" if value is None else type(value).__name__
