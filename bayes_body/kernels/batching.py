"""Apply a function of one particle to all particles, in batches spread over the devices.

On a CPU, a batch should fit into the cache, and the program should use every core. A `vmap` over all particles at once is half as fast
(docs/decisions). On an accelerator one `vmap` is best, but the work of many particles would not fit into its memory: a million gradients of four
views take 78 GB. There a batch is as large as WORK_BYTES and the memory allow (kernels/working_memory.py), and few particles are one batch.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from bayes_body.density.sharding import varying_like
from bayes_body.kernels.working_memory import work_bytes

BATCH = 32
# Rows of a graph in a batch. One row is enough work for a core: all pairs of particles of two nodes fill its cache.
ROWS = 1
# The mesh axis along which particles are distributed over devices.
DEVICES = "particle"
# On an accelerator: the most that the work of a batch takes, bytes, and as a share of the memory of the device.
WORK_BYTES, WORK_SHARE = 8e9, 1 / 4
# Several accelerators share the particles if there are more than these: with fewer, a frame takes one of them as long as with a tenth of them.
SHARED_FROM = 4096
# To look at the work of a particle is to trace its program again. Few particles are one batch without that: what fits with this much each, bytes.
MOST_WORK_BYTES = 20_000_000
# Where an accelerator does not say what memory it has, bytes.
USUAL_MEMORY = 8e9
_ALONE: ContextVar[bool] = ContextVar("one device", default=False)
_ASSUMED: ContextVar[float | None] = ContextVar("memory of an accelerator that is assumed", default=None)
_RUNS: ContextVar[int] = ContextVar("runs of a batch", default=1)


def over_particles(
    function: Callable[..., Any], particles: Any, shared: Any, batch: int = BATCH, checked: bool = True, axis: str | None = None
) -> Any:
    """Compute `vmap(function, (0, None))(particles, shared)` fast.

    Args:
        function: `(particle, shared) -> pytree`, for one particle.
        particles: pytree whose leaves have a leading particle axis.
        shared: an argument that is the same for all particles. Traced arrays must be passed here, not through a closure.
        batch: number of particles computed at once on one device of a CPU. On an accelerator the memory decides.
        checked: whether JAX checks which values differ between devices. It cannot do so in some loops of libraries.
        axis: a name of the particle axis, for collectives within the function (`axes_of`).
    """
    vmapped = jax.vmap(function, (0, None), axis_name=axis)
    count = jax.tree.leaves(particles)[0].shape[0]
    devices, memory = _devices(count, batch), accelerator_memory()
    if memory is None:
        batch = min(batch, count)
    else:
        share = -(-count // len(devices))
        # A collective covers the particles of one batch.
        batch = share if axis is not None else _batch_by_memory(share, lambda: work_bytes(function, particles, shared), memory)
        if batch == count:
            return vmapped(particles, shared)
    padded = jax.tree.map(lambda leaf: _pad(leaf, len(devices) * batch), particles)
    spread = _in_batches(vmapped, batch)
    if len(devices) > 1:
        mesh = Mesh(np.array(devices), (DEVICES,))
        split = PartitionSpec(DEVICES)
        spread = jax.shard_map(spread, mesh=mesh, in_specs=(split, PartitionSpec()), out_specs=split, check_vma=checked)
        if memory is not None:
            # Otherwise sums over particles outside the batches would be split, and their rounding would depend on the number of devices.
            padded, shared = jax.lax.with_sharding_constraint((padded, shared), replicated())
    results = spread(padded, shared)
    if len(devices) > 1:
        # Gather once. Otherwise all devices would stop to exchange a number at every later sum over particles.
        results = jax.lax.with_sharding_constraint(results, replicated())
    return jax.tree.map(lambda leaf: leaf[:count], results)


def accelerator_memory() -> float | None:
    """Return the memory of an accelerator that JAX may use, bytes; None if JAX computes on a CPU."""
    assumed = _ASSUMED.get()
    if assumed is not None or jax.default_backend() == "cpu":
        return assumed
    return float((jax.local_devices()[0].memory_stats() or {}).get("bytes_limit", USUAL_MEMORY))


@contextmanager
def assumed_accelerator(memory: float) -> Iterator[None]:
    """Build programs in the `with` block as for accelerators with this memory, bytes, so that a CPU can test them."""
    token = _ASSUMED.set(memory)
    try:
        yield
    finally:
        _ASSUMED.reset(token)


@contextmanager
def several_runs(runs: int) -> Iterator[None]:
    """Build a program in the `with` block that is mapped over runs: each needs the memory of a batch."""
    token = _RUNS.set(runs)
    try:
        yield
    finally:
        _RUNS.reset(token)


def work_room(memory: float) -> float:
    """Return how much of an accelerator's memory the work of a batch may take, bytes."""
    return min(WORK_BYTES, WORK_SHARE * memory)


def _batch_by_memory(count: int, bytes_of_one: Callable[[], int], memory: float) -> int:
    """Return how many of `count` particles are computed at once on an accelerator: all, or parts of about the same size."""
    room = work_room(memory) / _RUNS.get()
    if count * MOST_WORK_BYTES <= room:
        return count
    most = max(1, int(room / max(1, bytes_of_one())))
    return -(-count // -(-count // most))


@contextmanager
def one_device() -> Iterator[None]:
    """Let `over_particles` use one device in the `with` block, for a program that spreads something else over the devices, such as runs."""
    token = _ALONE.set(True)
    try:
        yield
    finally:
        _ALONE.reset(token)


def axes_of(count: int, batch: int, axis: str) -> tuple[str, ...]:
    """Return the axis names with which a collective within `over_particles` covers all `count` particles, if each device has one batch."""
    return (axis, DEVICES) if len(_devices(count, batch)) > 1 else (axis,)


def _devices(count: int, batch: int) -> list[Any]:
    # With few particles a second device does not help, and padding would cost more.
    least = batch if accelerator_memory() is None else SHARED_FROM
    return jax.devices() if count > least and not _ALONE.get() else jax.devices()[:1]


def _pad(leaf: jax.Array, multiple: int) -> jax.Array:
    missing = -leaf.shape[0] % multiple
    # Padding by a real particle keeps the arithmetic finite.
    return jnp.concatenate([leaf, jnp.broadcast_to(leaf[-1:], (missing, *leaf.shape[1:]))]) if missing else leaf


def _in_batches(vmapped: Callable[..., Any], batch: int) -> Callable[..., Any]:
    def run(particles: Any, shared: Any) -> Any:
        # Written out: a length of -1 is not inferred for arrays without entries.
        batches = jax.tree.map(lambda leaf: leaf.reshape(len(leaf) // batch, batch, *leaf.shape[1:]), particles)
        shared = jax.tree.map(lambda leaf: varying_like(leaf, particles) if _is_key(leaf) else leaf, shared)
        results = jax.lax.map(lambda part: vmapped(part, shared), batches)
        return jax.tree.map(lambda leaf: leaf.reshape(len(leaf) * batch, *leaf.shape[2:]), results)

    return run


def _is_key(leaf: Any) -> bool:
    # If parameters differ between devices, JAX refuses a common key for some draws, since this may be a mistake. Here it is intended.
    return isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def everywhere[Tree](tree: Tree) -> Tree:
    """Return the tree with its arrays replicated on every device. A program's arguments and results are placed like this."""
    return jax.device_put(tree, replicated())


def on_first_device[Tree](tree: Tree) -> Tree:
    """Return the tree with its arrays on the first device, for a program that is not spread: replicated, every device would compute it."""
    return jax.device_put(tree, jax.devices()[0])


def replicated() -> NamedSharding:
    """Return the sharding of an array that is replicated on every device."""
    return NamedSharding(Mesh(np.array(jax.devices()), (DEVICES,)), PartitionSpec())
