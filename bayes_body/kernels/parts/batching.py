"""A function of one particle, applied to all of them: in small batches, spread over the devices.

On a CPU a batch should fit the cache, and the program should run on every core: a `vmap` over all particles at once is half as fast (docs/decisions).
On an accelerator one `vmap` is best.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

BATCH = 32
# The axis along which devices share particles.
DEVICES = "particle"


def over_particles(
    function: Callable[..., Any], particles: Any, shared: Any, batch: int = BATCH, checked: bool = True, axis: str | None = None
) -> Any:
    """`vmap(function, (0, None))(particles, shared)`, fast.

    Args:
        function: `(particle, shared) -> pytree`, for one particle.
        particles: pytree whose leaves have a leading particle axis.
        shared: the same for all particles. Traced arrays must come in here, not through a closure.
        batch: particles computed at once on one device.
        checked: whether JAX checks which values differ between devices; it cannot in some loops of libraries.
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
        # Gathered once: otherwise all devices would stop to exchange a number at every later sum over particles.
        results = jax.lax.with_sharding_constraint(results, whole())
    return jax.tree.map(lambda leaf: leaf[:count], results)


def varying_like[Tree](tree: Tree, reference: Any) -> Tree:
    """The tree with its arrays marked as different from device to device, if those of the reference are.

    A loop within `over_particles` needs it for its first value, where that is a constant: it must have the type of the later ones.
    """
    axes = frozenset().union(*(jax.typeof(leaf).mat.varying for leaf in jax.tree.leaves(reference)))

    def marked(leaf: Any) -> jax.Array:
        # A library's state may hold plain numbers.
        leaf = jnp.asarray(leaf)
        missing = tuple(sorted(axes - jax.typeof(leaf).mat.varying))
        return jax.lax.pcast(leaf, missing, to="varying") if missing else leaf

    return jax.tree.map(marked, tree)


def axes_of(count: int, batch: int, axis: str) -> tuple[str, ...]:
    """The axis names with which a collective within `over_particles` reaches all `count` particles, if each device has one batch."""
    spread = jax.default_backend() == "cpu" and len(_devices(count, batch)) > 1
    return (axis, DEVICES) if spread else (axis,)


def _devices(count: int, batch: int) -> list[Any]:
    # A second device does not help a few particles, and their padding would cost more.
    return jax.devices() if count > batch else jax.devices()[:1]


def _pad(leaf: jax.Array, multiple: int) -> jax.Array:
    missing = -leaf.shape[0] % multiple
    # Repeating a real particle keeps the padding's arithmetic finite.
    return jnp.concatenate([leaf, jnp.broadcast_to(leaf[-1:], (missing, *leaf.shape[1:]))]) if missing else leaf


def _in_batches(vmapped: Callable[..., Any], batch: int) -> Callable[..., Any]:
    def run(particles: Any, shared: Any) -> Any:
        batches = jax.tree.map(lambda leaf: leaf.reshape(-1, batch, *leaf.shape[1:]), particles)
        results = jax.lax.map(lambda some: vmapped(some, shared), batches)
        return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), results)

    return run


def everywhere[Tree](tree: Tree) -> Tree:
    """The tree's arrays, whole, on every device: the placement of a program's arguments and results."""
    return jax.device_put(tree, whole())


def whole() -> NamedSharding:
    """The sharding of an array that every device holds whole."""
    return NamedSharding(Mesh(np.array(jax.devices()), (DEVICES,)), PartitionSpec())
