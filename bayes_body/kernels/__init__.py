"""Kernels, which map the particles of one frame to those of the next. `kernels.hmc(...)`, `kernels.sir(...)` and so on build them.

An option that is not given has the kernel's default, whatever the model's definition says. `Model.kernel` returns the kernel of the definition.
"""

from collections.abc import Callable
from functools import wraps
from inspect import signature

from pydantic import BaseModel

from bayes_body.density.kernel import Kernel, NamedKernel
from bayes_body.kernels.hmc import hmc_filter
from bayes_body.kernels.messages.particle_bp import build_kernel as particle_bp
from bayes_body.kernels.smc import annealed_filter, particle_filter, tempered_smc

__all__ = ["annealed", "hmc", "particle_bp", "sir", "tempered"]


def _named[**Arguments](kind: str, schema: type[BaseModel], build: Callable[Arguments, Kernel]) -> Callable[Arguments, NamedKernel]:
    """Return the build function of a kernel that knows its name and options."""

    @wraps(build)
    def named(*values: Arguments.args, **options: Arguments.kwargs) -> NamedKernel:
        function = build(*values, **options)
        arguments = dict(signature(build).bind(*values, **options).arguments)
        chosen = arguments.pop("options", {}) | arguments
        return NamedKernel(kind, schema(**{name: value for name, value in chosen.items() if name in schema.model_fields}), function)

    return named


annealed = _named("annealed", annealed_filter.Options, annealed_filter.build_kernel)
hmc = _named("hmc", hmc_filter.Options, hmc_filter.build_kernel)
sir = _named("sir", particle_filter.Options, particle_filter.build_kernel)
tempered = _named("tempered", tempered_smc.Options, tempered_smc.build_kernel)
