"""The interface of spaces. A space is static: a frozen dataclass of tuples, which can be hashed and compared."""

from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Array, Float

# Points have the space's shape after any leading axes. Tangent vectors are flat. JAX arrays give JAX arrays, NumPy arrays give NumPy arrays.
type Points = Float[Array | np.ndarray, "..."]
type Vectors = Float[Array | np.ndarray, "... dimension"]
type Weights = Float[Array | np.ndarray, "... draw"]
type Numbers = Float[Array | np.ndarray, "..."]


class Axis(NamedTuple):
    """One axis of a point.

    Attributes:
        name: its name where points are stored; empty for an axis that is named after its variable.
        labels: the names of its entries.
        units: the units of its entries, `m`, `rad` or `1`; empty if an entry has no single unit, as for the parts of a body.
    """

    name: str
    labels: tuple[str, ...]
    units: tuple[str, ...] = ()


@runtime_checkable
class Space(Protocol):
    """The space of a variable. All functions accept leading axes, which are broadcast, and keep the precision of their arguments."""

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of a point."""
        ...

    @property
    def axes(self) -> tuple[Axis, ...]:
        """The axes of a point."""
        ...

    @property
    def dimension(self) -> int:
        """The number of entries of a tangent vector."""
        ...

    @property
    def tangent_labels(self) -> tuple[str, ...]:
        """The names of the entries of a tangent vector."""
        ...

    @property
    def tangent_units(self) -> tuple[str, ...]:
        """The units of the entries of a tangent vector."""
        ...

    @property
    def blocks(self) -> tuple[int, ...]:
        """For each entry of a point, flattened, the number of its block. Points may exchange blocks, but not pieces of a block."""
        ...

    def local(self, x: Points, y: Points) -> Vectors:
        """Return the tangent vector at x that leads to y by the shortest way."""
        ...

    def retract(self, x: Points, v: Vectors) -> Points:
        """Return the point to which the tangent vector v leads from x; the inverse of `local`."""
        ...

    def coordinates(self, centre: Points, y: Points) -> Vectors:
        """Return flat coordinates of y, in which means, quantiles and ranks are taken; they are exact near the centre.

        For numbers they are the numbers themselves. For an angle they are the angle on the turn nearest to the centre. For a rotation they are the
        tangent vector at the centre that leads to it.
        """
        ...

    def mean(self, weights: Weights, points: Points) -> Points:
        """Return the intrinsic mean of draws: the point with the smallest mean squared distance to them.

        The axis of the draws is before those of a point. The weights of all draws sum to one.
        """
        ...

    def distance(self, x: Points, y: Points) -> Numbers:
        """Return the length of `local(x, y)`, where a metre counts as much as a radian."""
        ...

    def log_measure(self, v: Vectors) -> Numbers:
        """Return the logarithm of the reference measure at the point `retract(x, v)` relative to Lebesgue measure dv; it does not depend on x."""
        ...

    def images(self, v: Vectors) -> Vectors:
        """Return v and the next longer tangent vectors to the same point, such as a full turn more or less: (..., image, dimension)."""
        ...
