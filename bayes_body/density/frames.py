"""The densities of consecutive frames as one pytree: what all frames share is stored once, and the frames' data are stacked.

A function of all frames, such as a trajectory's density, then contains each likelihood once, however many frames there are. It is not traced again
for the same number of other frames.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bayes_body.base.errors import input_error
from bayes_body.base.shapes import Index, Scalar
from bayes_body.density.density import Density
from bayes_body.density.factor import Data, Factor, Particles, State, Transition

# The part of one frame: its factors if they differ between frames, and its data.
type Inputs = tuple[tuple[Factor, ...] | None, Data]


@partial(jax.tree_util.register_dataclass, meta_fields=["moving"], data_fields=["transition", "factors", "data"])
@dataclass(frozen=True, eq=False)
class Frames:
    """Consecutive frames. Create them with `stacked`.

    Attributes:
        transition: the motion prior.
        factors: all other terms; with a leading frame axis if they differ, as those of a moving camera do.
        data: the data of the factors, by factor name, with a leading frame axis.
        moving: whether the factors differ between frames.
    """

    transition: Transition
    factors: tuple[Factor, ...]
    data: Data
    moving: bool

    @property
    def inputs(self) -> Inputs:
        """The parts of all frames, with a leading frame axis, for a `scan` or a `vmap`."""
        return (self.factors if self.moving else None), self.data

    def density(self, inputs: Inputs, previous: Particles) -> Density:
        """Return the density of one frame, given its part of `inputs` and the particles of the previous frame."""
        factors, data = inputs
        return Density(self.transition, self.factors if factors is None else factors, data, previous)

    def log_single_frame(self, inputs: Inputs, state: State) -> Scalar:
        """Return the sum of those factors of one frame that do not read the previous frame."""
        factors, data = inputs
        reading = tuple(factor for factor in (self.factors if factors is None else factors) if not factor.reads_previous)
        return Density(self.transition, reading, data, Particles({}, jnp.zeros(1))).log_weight(state, {})

    @property
    def linked(self) -> bool:
        """Whether a factor reads the previous frame."""
        return any(factor.reads_previous for factor in self.factors)

    def window(self, begin: int | Index, count: int) -> "Frames":
        """Return `count` frames, beginning with number `begin`."""

        def cut(leaf: Any) -> Any:
            return jax.lax.dynamic_slice_in_dim(leaf, begin, count)

        return replace(self, factors=jax.tree.map(cut, self.factors) if self.moving else self.factors, data=jax.tree.map(cut, dict(self.data)))


def stacked(densities: Sequence[Density]) -> Frames:
    """Return consecutive frames from their densities. The particles of their previous frames are left out.

    Raises:
        InputError: there is no frame, or the frames' data differ in shape.
    """
    if not densities:
        raise input_error("the frames", "none", "one or more", "give the densities of some frames")
    first = densities[0]
    forms = [[(np.shape(leaf), jnp.result_type(leaf)) for leaf in jax.tree.leaves((density.factors, dict(density.data)))] for density in densities]
    for number, (density, form) in enumerate(zip(densities, forms, strict=True)):
        if form != forms[0] or jax.tree.structure(dict(density.data)) != jax.tree.structure(dict(first.data)):
            raise input_error(
                f"frame {number} of the window", "data of other shapes than the first frame's", "the same shapes", "choose other frames"
            )
    moving = not all(_same(first.factors, density.factors) for density in densities[1:])
    factors = jax.tree.map(_stack, *(density.factors for density in densities)) if moving else first.factors
    return Frames(first.transition, factors, jax.tree.map(_stack, *(dict(density.data) for density in densities)), moving)


def _stack(*leaves: Any) -> jax.Array:
    return jnp.stack([jnp.asarray(leaf) for leaf in leaves])


def _same(first: Any, second: Any) -> bool:
    return all(a is b or np.array_equal(a, b) for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True))
