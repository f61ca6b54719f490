"""The size of a run before it begins: what cannot fit into the memory, or would never end, is refused before anything is allocated.

The room on the disk that a run needs: said before it begins.

A particle takes its state, a weight and an ancestor. While a run goes on there is a file for each frame. When `posterior.nc` is complete, it has the
same numbers, and the files are removed. So for a moment the run needs twice the room that it has in the end.
"""

import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import jax
import numpy as np

from bayes_body.base.errors import input_error
from bayes_body.initial import Show
from bayes_body.model.body.solids import configuration_space
from bayes_body.model.build import Model
from bayes_body.view.figures_text import warning_line

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
        problem = f"at least {gigabytes(needed)} of memory for {many}"
        raise input_error("--particles, --runs", problem, f"at most the {gigabytes(available)} that there are", "give fewer particles or runs")
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


def gigabytes(count: int) -> str:
    """Return a size as text, 10⁹ bytes."""
    return f"{count / 1e9:,.1f} GB"


# Of each particle, besides its state: its weight and its ancestor.
WEIGHT_AND_ANCESTOR_BYTES = 8
# Of each frame and run: figures of the kernel, and names of the arrays.
FRAME_BYTES = 3_000
MEGABYTE = 1e6


def disk_lines(out: Path, model: Model, options: Mapping[str, Any], runs: int, frames: int, done: int, keep: int | None) -> Iterator[str]:
    """Yield a line about the room that a run needs, without its pictures, and a warning if the disk has less.

    Args:
        out: the folder of the run, which exists.
        model: the model; its state gives the size of a particle.
        options: all options of the kernel.
        runs: number of independent filters.
        frames: number of frames.
        done: how many of them are stored already.
        keep: number of draws of a frame and run that are stored; None for all particles.
    """
    particles = options["particles"]
    whole = frame_bytes(model, particles, runs)
    frame = whole if keep is None else frame_bytes(model, min(keep, particles), runs)
    posterior = frames * frame
    # The frames that are not stored yet, the posterior beside all frames, and of a thinned run the last frame with all its particles, twice.
    needed = (frames - done) * frame + posterior + (0 if keep is None else 2 * whole)
    free = shutil.disk_usage(out).free
    yield (
        f"disk       {megabytes(frames * frame)} for {frames} frames of {megabytes(frame)}, and as much again until posterior.nc is complete; "
        f"pictures come on top; {megabytes(free)} are free"
    )
    if needed > free:
        remedy = "free some space, or store fewer draws with --keep draws=200" if keep is None else "free some space, or give fewer runs or draws"
        yield warning_line(f"the run will not fit on the disk: it needs {megabytes(needed)}, and {megabytes(free)} are free; {remedy}.")


def frame_bytes(model: Model, particles: int, runs: int) -> int:
    """Return the size of a frame, bytes."""
    state = sum(np.asarray(leaf).nbytes for leaf in jax.tree.leaves(dict(model.initial)))
    return runs * (particles * (state + WEIGHT_AND_ANCESTOR_BYTES) + FRAME_BYTES)


def draws_to_keep(keep: int | None, options: Mapping[str, Any], show: Show) -> int | None:
    """Return how many draws are stored; None for all particles, and if a run has no more."""
    if keep is not None and keep >= options["particles"]:
        show(f"note: all {options['particles']} particles are stored: --keep draws={keep} leaves none out.")
        return None
    return keep


def megabytes(count: int) -> str:
    """Return a size as text, 10⁶ bytes."""
    size = count / MEGABYTE
    return f"{size:,.0f} MB" if size >= 10 else f"{size:.2g} MB"
