"""Kernels: from the particles of one frame to those of the next. `kernels.annealed(...)` and `kernels.sir(...)` build them."""

from bayes_body.kernels.annealed_filter import build_kernel as annealed
from bayes_body.kernels.particle_filter import build_kernel as sir

__all__ = ["annealed", "sir"]
