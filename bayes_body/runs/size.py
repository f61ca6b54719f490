"""The size of a run before it begins: what cannot fit into the memory, or would never end, is refused before anything is allocated.

The room on the disk that a run needs: said before it begins.

A particle takes its state, a weight and an ancestor. While a run goes on there is a file for each frame, in which the names of the arrays take some
ten thousand bytes more. When `posterior.nc` is complete, it has the same numbers, and the files are removed. So for a moment the run needs more than
twice the room that it has in the end.
"""

import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from bayes_body.base.errors import input_error
from bayes_body.initial import Show
from bayes_body.kernels.batching import accelerator_memory, work_room
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
    needed, available = least_bytes(configuration_space(model.body).dimension, options["particles"], runs), particle_memory()
    if available is not None and needed > available:
        many = f"{options['particles']} particles" + (f" in each of {runs} runs" if runs > 1 else "")
        problem = f"at least {gigabytes(needed)} of memory for {many}"
        raise input_error("--particles, --runs", problem, f"at most the {gigabytes(available)} that there are", "give fewer particles or runs")
    if runs > MOST:
        raise input_error("--runs", str(runs), f"at most {MOST}", "give a smaller number")


def least_bytes(dofs: int, particles: int, runs: int) -> int:
    """Return a lower bound of the memory for the particles of a frame, bytes."""
    return runs * (RUN_BYTES + COPIES * NUMBER_BYTES * particles * (dofs + WEIGHT_AND_ANCESTOR))


def particle_memory() -> int | None:
    """Return the memory for the particles of all runs, bytes: on an accelerator without that for the work of a batch. None if it is not known."""
    whole = memory_bytes()
    return whole if whole is None or accelerator_memory() is None else whole - int(work_room(float(whole)))


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
# Of each run in a frame: figures of the kernel. Of each array in the file of a frame: its name and its shape, twice.
RUN_FIGURES_BYTES, ARRAY_BYTES = 100, 260
# Arrays of a frame besides those of its state; figures of all particles of a thinned run besides two for each variable.
ARRAYS, THINNED_ARRAYS = 21, 5
# A file takes whole blocks of a disk: on average half of one is empty.
HALF_BLOCK = 2048
# From this size on, bytes, it is said how much smaller a thinned run is.
LARGE, PROPOSED = 5_000_000_000, 200
MEGABYTE = 1e6


class FrameSize(NamedTuple):
    """Bytes of a frame: in `posterior.nc`, and in its own file until that is complete."""

    stored: int
    file: int


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
    thinned = keep is not None and keep < particles
    frame = frame_size(model, min(keep, particles) if keep is not None else particles, runs, thinned)
    # Of a thinned run, the last frame with all its particles, twice.
    last_frame = 2 * frame_size(model, particles, runs).file if thinned else 0
    remedy = "give fewer runs or draws" if keep is not None else "store fewer draws with --keep draws=200"
    yield from _room(out, frame, frames, done, last_frame, remedy)
    if keep is None and frames * frame.stored > LARGE and particles > PROPOSED:
        smaller = frames * frame_size(model, PROPOSED, runs, True).stored
        yield f"note: with --keep draws={PROPOSED} it is {megabytes(smaller)}; means, R-hat and other diagnostics stay those of all particles."


def smoothing_lines(out: Path, model: Model, draws: int, runs: int, frames: int, done: int) -> Iterator[str]:
    """Yield a line about the room that a smoothed run needs, without its pictures, and a warning if the disk has less.

    Args:
        out: the folder of the run, which exists.
        model: as for `disk_lines`.
        draws: number of paths of each run.
        runs: number of runs of the filter.
        frames: number of frames.
        done: how many of them are stored already.
    """
    yield from _room(out, frame_size(model, draws, runs), frames, done, 0, "draw fewer paths with --draws 50")


def _room(out: Path, frame: FrameSize, frames: int, done: int, beside: int, remedy: str) -> Iterator[str]:
    stored, more, free = frames * frame.stored, frames * frame.file, shutil.disk_usage(out).free
    room = f"{megabytes(stored)} for {frames} frames of {megabytes(frame.stored)}, and {megabytes(more)} more until posterior.nc is complete"
    yield f"disk       {room}; pictures come on top; {megabytes(free)} are free"
    # The frames that are not stored yet, and the posterior beside all frames.
    needed = (frames - done) * frame.file + stored + beside
    if needed > free:
        fault = f"the run will not fit on the disk: it needs {megabytes(needed)}, and {megabytes(free)} are free"
        yield warning_line(f"{fault}; free some space, or {remedy}.")


def frame_size(model: Model, draws: int, runs: int, thinned: bool = False) -> FrameSize:
    """Return the size of a frame.

    Args:
        model: its state gives the size of a draw.
        draws: number of draws of a run.
        runs: number of runs.
        thinned: whether the draws are some of the particles, so that figures of all are stored beside them.
    """
    leaves = jax.tree.leaves(dict(model.initial))
    state = sum(np.asarray(leaf).nbytes for leaf in leaves)
    stored = runs * (draws * (state + WEIGHT_AND_ANCESTOR_BYTES) + RUN_FIGURES_BYTES)
    arrays = ARRAYS + len(leaves)
    if thinned:
        # The mean of each run, and R-hat, which has twice as many bytes.
        stored += (runs + 2) * state
        arrays += THINNED_ARRAYS + 2 * len(leaves)
    return FrameSize(stored, stored + arrays * ARRAY_BYTES + HALF_BLOCK)


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
