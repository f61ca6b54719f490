"""Types of values inside `shard_map`: whether an array varies from device to device is part of its type."""

from typing import Any

import jax
import jax.numpy as jnp


def varying_like[Tree](tree: Tree, reference: Any) -> Tree:
    """Return the tree with its arrays marked as varying over devices if the arrays of the reference vary.

    A loop inside `shard_map` needs this if its initial value is a constant: the initial value must have the same type as later ones.
    """
    axes = frozenset().union(*(jax.typeof(leaf).mat.varying for leaf in jax.tree.leaves(reference)))

    def marked(leaf: Any) -> jax.Array:
        # The state of a library may contain plain numbers.
        leaf = jnp.asarray(leaf)
        missing = tuple(sorted(axes - jax.typeof(leaf).mat.varying))
        return jax.lax.pcast(leaf, missing, to="varying") if missing else leaf

    return jax.tree.map(marked, tree)
