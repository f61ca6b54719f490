"""Apply a function of one particle to all particles, in small batches spread over the devices.

On a CPU, a batch should fit into the cache, and the program should use every core. A `vmap` over all particles at once is half as fast
(docs/decisions). On an accelerator, one `vmap` is best.
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

BATCH = 32
# Rows of a graph in a batch. One row is enough work for a core: all pairs of particles of two nodes fill its cache.
ROWS = 1
# The mesh axis along which particles are distributed over devices.
DEVICES = "particle"
_ALONE: ContextVar[bool] = ContextVar("one device", default=False)


def over_particles(
    function: Callable[..., Any], particles: Any, shared: Any, batch: int = BATCH, checked: bool = True, axis: str | None = None
) -> Any:
    """Compute `vmap(function, (0, None))(particles, shared)` fast.

    Args:
        function: `(particle, shared) -> pytree`, for one particle.
        particles: pytree whose leaves have a leading particle axis.
        shared: an argument that is the same for all particles. Traced arrays must be passed here, not through a closure.
        batch: number of particles computed at once on one device.
        checked: whether JAX checks which values differ between devices. It cannot do so in some loops of libraries.
        axis: a name of the particle axis, for collectives within the function (`axes_of`).
    """
    vmapped = jax.vmap(function, (0, None), axis_name=axis)
    if jax.default_backend() != "cpu":
        return vmapped(particles, shared)
    count = jax.tree.leaves(particles)[0].shape[0]
    devices = _devices(count, batch)
    batch = min(batch, count)
    padded = jax.tree.map(lambda leaf: _pad(leaf, len(devices) * batch), particles)
    spread = _in_batches(vmapped, batch)
    if len(devices) > 1:
        mesh = Mesh(np.array(devices), (DEVICES,))
        split = PartitionSpec(DEVICES)
        spread = jax.shard_map(spread, mesh=mesh, in_specs=(split, PartitionSpec()), out_specs=split, check_vma=checked)
    results = spread(padded, shared)
    if len(devices) > 1:
        # Gather once. Otherwise all devices would stop to exchange a number at every later sum over particles.
        results = jax.lax.with_sharding_constraint(results, replicated())
    return jax.tree.map(lambda leaf: leaf[:count], results)


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
    spread = jax.default_backend() == "cpu" and len(_devices(count, batch)) > 1
    return (axis, DEVICES) if spread else (axis,)


def _devices(count: int, batch: int) -> list[Any]:
    # With few particles a second device does not help, and padding would cost more.
    return jax.devices() if count > batch and not _ALONE.get() else jax.devices()[:1]


def _pad(leaf: jax.Array, multiple: int) -> jax.Array:
    missing = -leaf.shape[0] % multiple
    # Padding by a real particle keeps the arithmetic finite.
    return jnp.concatenate([leaf, jnp.broadcast_to(leaf[-1:], (missing, *leaf.shape[1:]))]) if missing else leaf


def _in_batches(vmapped: Callable[..., Any], batch: int) -> Callable[..., Any]:
    def run(particles: Any, shared: Any) -> Any:
        batches = jax.tree.map(lambda leaf: leaf.reshape(-1, batch, *leaf.shape[1:]), particles)
        shared = jax.tree.map(lambda leaf: varying_like(leaf, particles) if _is_key(leaf) else leaf, shared)
        results = jax.lax.map(lambda part: vmapped(part, shared), batches)
        return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), results)

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
