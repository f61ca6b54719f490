"""The size of a run before it begins: what cannot fit into the memory, or would never end, is refused before anything is allocated."""

import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import jax

from bayes_body.base.errors import input_error
from bayes_body.model.body.space import configuration_space
from bayes_body.model.build import Model

# Larger counts of runs, layers, moves, leapfrog steps ... are mistakes of typing: such a run would not end.
MOST = 100_000
# Numbers of a particle besides its pose: its weight and its ancestor. All are copied from before a frame to after it, to the host, and to one array.
WEIGHT_AND_ANCESTOR, COPIES, NUMBER_BYTES = 2, 4, 4
# Of each run, whatever its particles: less than was measured.
RUN_BYTES = 16_000
# Where Linux says how much memory a container may have.
CONTAINER_LIMIT = Path("/sys/fs/cgroup/memory.max")


def check_size(model: Model, options: Mapping[str, Any], runs: int) -> None:
    """Refuse a run that needs more memory than the machine has, or has counts that cannot be meant.

    Args:
        model: the model; its body gives the size of a particle.
        options: all options of the kernel.
        runs: number of independent filters.

    Raises:
        InputError: it is too large.
    """
    for name, value in options.items():
        if isinstance(value, int) and name != "particles" and value > MOST:
            raise input_error(f"the kernel's {name}", str(value), f"at most {MOST}", "give a smaller number")
    needed, available = least_bytes(configuration_space(model.body).dimension, options["particles"], runs), memory_bytes()
    if available is not None and needed > available:
        many = f"{options['particles']} particles" + (f" in each of {runs} runs" if runs > 1 else "")
        problem = f"at least {_gigabytes(needed)} of memory for {many}"
        raise input_error("--particles, --runs", problem, f"at most the {_gigabytes(available)} that there are", "give fewer particles or runs")
    if runs > MOST:
        raise input_error("--runs", str(runs), f"at most {MOST}", "give a smaller number")


def least_bytes(dofs: int, particles: int, runs: int) -> int:
    """Return a lower bound of the memory for the particles of a frame, bytes."""
    return runs * (RUN_BYTES + COPIES * NUMBER_BYTES * particles * (dofs + WEIGHT_AND_ANCESTOR))


def memory_bytes() -> int | None:
    """Return the memory of the device that computes, bytes; None where the system does not say."""
    of_device = jax.local_devices()[0].memory_stats()
    if of_device and "bytes_limit" in of_device:
        return int(of_device["bytes_limit"])
    limits = []
    with suppress(OSError, ValueError, AttributeError):
        limits.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    with suppress(OSError, ValueError):
        limits.append(int(CONTAINER_LIMIT.read_text(encoding="utf-8")))
    return min(limits, default=None)


def _gigabytes(count: int) -> str:
    return f"{count / 1e9:,.1f} GB"
