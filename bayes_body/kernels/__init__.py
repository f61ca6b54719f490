"""Kernels, which map the particles of one frame to those of the next. `kernels.hmc(...)`, `kernels.sir(...)` and so on build them.

An option that is not given has the kernel's default, whatever the model's definition says. `Model.kernel` returns the kernel of the definition.
"""

from collections.abc import Callable
from functools import wraps
from inspect import Parameter, Signature, signature
from textwrap import fill
from typing import Any, get_type_hints

from pydantic import BaseModel

from bayes_body.base.toml.options import options_of
from bayes_body.density.kernel import Kernel, NamedKernel
from bayes_body.kernels.hmc import hmc_filter
from bayes_body.kernels.laplace import laplace_filter
from bayes_body.kernels.messages import particle_bp as message_passing
from bayes_body.kernels.smc import annealed_filter, particle_filter, tempered_smc

__all__ = ["annealed", "hmc", "laplace", "particle_bp", "sir", "tempered"]


def _named[**Arguments](kind: str, schema: type[BaseModel], build: Callable[Arguments, Kernel]) -> Callable[Arguments, NamedKernel]:
    """Return a build function whose kernel knows its name and options, and whose signature shows all options."""

    @wraps(build)
    def named(*values: Arguments.args, **options: Arguments.kwargs) -> NamedKernel:
        function = build(*values, **options)
        arguments = dict(signature(build).bind(*values, **options).arguments)
        chosen = arguments.pop("options", {}) | arguments
        return NamedKernel(kind, schema(**{name: value for name, value in chosen.items() if name in schema.model_fields}), function)

    return _showing(kind, schema, named, build)


def _showing[Function: Callable[..., Any]](kind: str, schema: type[BaseModel], function: Function, build: Callable[..., Any]) -> Function:
    """Let `help` and editors show all options of a kernel."""
    shown: Any = function
    shown.__signature__ = _signature_with_options(build, schema)
    shown.__name__ = shown.__qualname__ = kind
    shown.__doc__ = f"{shown.__doc__}\n    Options:\n{_explained(schema)}\n"
    return function


def _signature_with_options(build: Callable[..., Any], schema: type[BaseModel]) -> Signature:
    """Return the signature of a build function with the fields of its options in place of `**options`."""
    written = signature(build)
    named = {name: parameter for name, parameter in written.parameters.items() if parameter.kind is not Parameter.VAR_KEYWORD}
    if len(named) < len(written.parameters):
        types = get_type_hints(schema)
        for name, field in schema.model_fields.items():
            if name not in named and name != "particles":
                default = field.get_default(call_default_factory=True)
                named[name] = Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=types[name])
    return written.replace(parameters=list(named.values()))


def _explained(schema: type[BaseModel]) -> str:
    lines = (f"{option.key}: {option.text}{f' ({option.unit})' if option.unit else ''}; {option.default}" for option in options_of(schema))
    return "\n".join(fill(line, 120, initial_indent=" " * 8, subsequent_indent=" " * 12) for line in lines)


annealed = _named("annealed", annealed_filter.Options, annealed_filter.build_kernel)
hmc = _named("hmc", hmc_filter.Options, hmc_filter.build_kernel)
laplace = _named("laplace", laplace_filter.Options, laplace_filter.build_kernel)
particle_bp = _showing("particle_bp", message_passing.Options, message_passing.build_kernel, message_passing.build_kernel)
sir = _named("sir", particle_filter.Options, particle_filter.build_kernel)
tempered = _named("tempered", tempered_smc.Options, tempered_smc.build_kernel)
