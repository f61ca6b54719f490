"""Kernels, which map the particles of one frame to those of the next. `kernels.hmc(...)`, `kernels.sir(...)` and so on build them."""

from bayes_body.kernels.annealed_filter import build_kernel as annealed
from bayes_body.kernels.hmc_filter import build_kernel as hmc
from bayes_body.kernels.particle_bp import build_kernel as particle_bp
from bayes_body.kernels.particle_filter import build_kernel as sir
from bayes_body.kernels.tempered_smc import build_kernel as tempered

__all__ = ["annealed", "hmc", "particle_bp", "sir", "tempered"]
