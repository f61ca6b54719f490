"""The array library of an argument: one formula serves JAX, in single precision and inside traces, and NumPy, in double precision on the host."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array


def namespace(*arrays: Any) -> Any:
    """Return `jax.numpy` if one of the arrays is JAX's (traced or not), else `numpy`."""
    return jnp if any(isinstance(array, jax.Array) for array in arrays) else np


def joined(*arrays: Any) -> Any:
    """Return the arrays joined along the last axis; their leading axes are broadcast."""
    xp = namespace(*arrays)
    batch = xp.broadcast_shapes(*(array.shape[:-1] for array in arrays))
    return xp.concatenate([xp.broadcast_to(array, (*batch, array.shape[-1])) for array in arrays], axis=-1)


def device_array(values: Any, dtype: Any = float) -> Array:
    """Return numbers of the host as an array of the device, of the same shape, without compiling anything.

    `jnp.asarray` compiles a program for each shape if it must convert the numbers, or is given no dtype.
    """
    on_host = np.asarray(values, jax.dtypes.canonicalize_dtype(dtype))
    return jnp.asarray(on_host, on_host.dtype)
