"""Arrays of numbers. Each entry is Euclidean, inside limits (a box), or an angle on the circle; a mask lets all be computed together.

A pose of a body is such an array. An angle on the circle keeps its full turns when it moves, so that curves over time are continuous; differences and
averages ignore full turns.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from bayes_body.base.geometry.namespaces import namespace
from bayes_body.density.spaces.space import Axis, Numbers, Points, Vectors, Weights

TURN = 2 * math.pi


@dataclass(frozen=True)
class Flat:
    """Numbers in an array of any shape. Make one with `euclidean`, `box`, `circle` or `flat`.

    Attributes:
        labels: names of the entries, flattened.
        units: units of the entries.
        turning: for each entry, whether it is an angle on the circle (radians).
        low: lower limits, -inf where there is none.
        high: upper limits.
        shape: shape of a point.
        axis: name of the axis of a vector where it is stored; empty: it is named after the variable.
    """

    labels: tuple[str, ...]
    units: tuple[str, ...]
    turning: tuple[bool, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    shape: tuple[int, ...]
    axis: str = ""

    @property
    def axes(self) -> tuple[Axis, ...]:
        """The axes of a point; those of a matrix have no labels."""
        if len(self.shape) == 1:
            return (Axis(self.axis, self.labels, self.units),)
        return tuple(Axis("", ()) for _ in self.shape)

    @property
    def dimension(self) -> int:
        """The number of entries."""
        return len(self.labels)

    @property
    def tangent_labels(self) -> tuple[str, ...]:
        """The labels of the entries."""
        return self.labels

    @property
    def tangent_units(self) -> tuple[str, ...]:
        """The units of the entries."""
        return self.units

    @property
    def blocks(self) -> tuple[int, ...]:
        """Each entry is a block."""
        return tuple(range(len(self.labels)))

    def local(self, x: Points, y: Points) -> Vectors:
        """Return y - x, for an angle the shorter way round."""
        difference = self._vector(y) - self._vector(x)
        return difference - self._turns(difference) if any(self.turning) else difference

    def retract(self, x: Points, v: Vectors) -> Points:
        """Return x + v, clipped to the limits."""
        moved = self._vector(x) + v
        if np.isfinite((self.low, self.high)).any():
            moved = namespace(moved).clip(moved, np.asarray(self.low, moved.dtype), np.asarray(self.high, moved.dtype))
        return self._point(moved)

    def coordinates(self, centre: Points, y: Points) -> Vectors:
        """Return y, with its angles on the turn nearest to the centre."""
        values = self._vector(y)
        return values - self._turns(values - self._vector(centre)) if any(self.turning) else values

    def mean(self, weights: Weights, points: Points) -> Points:
        """Return the weighted mean. The mean of an angle is on the turn nearest to the arithmetic mean, so it keeps full turns."""
        values = self._vector(points)
        plain = _average(weights, values)
        if any(self.turning):
            xp = namespace(weights, points)
            # The circle is cut opposite to the mean of the unit vectors.
            circular = xp.arctan2(_average(weights, xp.sin(values)), _average(weights, xp.cos(values)))
            centre = circular + TURN * xp.round((plain - circular) / TURN)
            plain = _average(weights, values - self._turns(values - centre[..., None, :]))
        return self._point(plain)

    def distance(self, x: Points, y: Points) -> Numbers:
        """Return the Euclidean length of the difference."""
        return length(self.local(x, y))

    def log_measure(self, v: Vectors) -> Numbers:
        """Return zero: the reference measure is Lebesgue measure."""
        return 0.0 * v[..., 0]

    def images(self, v: Vectors) -> Vectors:
        """Return v, and v with one angle at a time a full turn larger or smaller."""
        turns = TURN * np.eye(self.dimension)[self.turns]
        return v[..., None, :] + np.concatenate([np.zeros((1, self.dimension)), turns, -turns]).astype(v.dtype)

    @property
    def turns(self) -> Bool[np.ndarray, " entry"]:
        """The mask of the entries on the circle."""
        return np.asarray(self.turning)

    def _turns(self, difference: Vectors) -> Vectors:
        """Return the full turns in a difference; zero for entries that are not on the circle."""
        return np.where(self.turns, TURN, 0.0).astype(difference.dtype) * namespace(difference).round(difference / TURN)

    def _vector(self, x: Points) -> Vectors:
        return x if len(self.shape) == 1 else x.reshape((*x.shape[: x.ndim - len(self.shape)], len(self.labels)))

    def _point(self, v: Vectors) -> Points:
        return v if len(self.shape) == 1 else v.reshape((*v.shape[:-1], *self.shape))


def flat(
    labels: tuple[str, ...], units: tuple[str, ...], turning: tuple[bool, ...], low: tuple[float, ...], high: tuple[float, ...], axis: str = ""
) -> Flat:
    """Return a vector whose entries are of several kinds. Its arguments are those of `Flat`."""
    return Flat(labels, units, turning, low, high, (len(labels),), axis)


def euclidean(labels: tuple[str, ...], units: tuple[str, ...], axis: str = "") -> Flat:
    """Return a vector of numbers without limits."""
    return box(labels, units, (-math.inf,) * len(labels), (math.inf,) * len(labels), axis)


def box(labels: tuple[str, ...], units: tuple[str, ...], low: tuple[float, ...], high: tuple[float, ...], axis: str = "") -> Flat:
    """Return a vector of numbers inside limits."""
    return flat(labels, units, (False,) * len(labels), low, high, axis)


def circle(labels: tuple[str, ...], axis: str = "") -> Flat:
    """Return a vector of angles without limits, radians."""
    infinite = (math.inf,) * len(labels)
    return flat(labels, ("rad",) * len(labels), (True,) * len(labels), tuple(-value for value in infinite), infinite, axis)


def numbered(name: str, shape: tuple[int, ...]) -> Flat:
    """Return the Euclidean space of an array without a declared space; its entries are `name_0`, `name_1_0` and so on."""
    labels = tuple("_".join([name, *map(str, index)]) for index in np.ndindex(*shape))
    infinite = (math.inf,) * len(labels)
    return Flat(labels, ("",) * len(labels), (False,) * len(labels), tuple(-value for value in infinite), infinite, shape)


def length(v: Vectors) -> Numbers:
    """Return the Euclidean length over the last axis, with the gradient 0 at the zero vector."""
    xp = namespace(v)
    square = xp.sum(v * v, axis=-1)
    return xp.where(square > 0, xp.sqrt(xp.where(square > 0, square, 1.0)), 0.0)


def _average(weights: Weights, values: Points) -> Vectors:
    return namespace(weights, values).einsum("...s,...sk->...k", weights, values)
