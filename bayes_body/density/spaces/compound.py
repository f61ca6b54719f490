"""Spaces made of others: a vector of consecutive pieces, and a plate of several equal ones."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from bayes_body.base.geometry.namespaces import joined, namespace
from bayes_body.density.spaces.flat import length
from bayes_body.density.spaces.space import Axis, Numbers, Points, Space, Vectors, Weights


@dataclass(frozen=True)
class Product:
    """A vector that consists of consecutive pieces, each in its own space.

    Attributes:
        names: names of the pieces, which precede the labels of their entries; with an empty name, the labels stay as they are.
        pieces: the spaces of the pieces, whose points are vectors.
        axis: name of the axis of a point where it is stored; empty: it is named after the variable.
    """

    names: tuple[str, ...]
    pieces: tuple[Space, ...]
    axis: str = ""

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of a point."""
        return (sum(piece.shape[0] for piece in self.pieces),)

    @property
    def axes(self) -> tuple[Axis, ...]:
        """One axis, the entries of all pieces."""
        piece_axes = [piece.axes[0] for piece in self.pieces]
        return (Axis(self.axis, _named(self.names, [axis.labels for axis in piece_axes]), tuple(unit for axis in piece_axes for unit in axis.units)),)

    @property
    def dimension(self) -> int:
        """The number of entries of a tangent vector."""
        return sum(piece.dimension for piece in self.pieces)

    @property
    def tangent_labels(self) -> tuple[str, ...]:
        """The labels of the pieces."""
        return _named(self.names, [piece.tangent_labels for piece in self.pieces])

    @property
    def tangent_units(self) -> tuple[str, ...]:
        """The units of the pieces."""
        return tuple(unit for piece in self.pieces for unit in piece.tangent_units)

    @property
    def blocks(self) -> tuple[int, ...]:
        """The blocks of the pieces, one after the other."""
        blocks: list[int] = []
        for piece in self.pieces:
            first = max(blocks, default=-1) + 1
            blocks += [first + block for block in piece.blocks]
        return tuple(blocks)

    def local(self, x: Points, y: Points) -> Vectors:
        """Return the tangent vectors of the pieces."""
        return self._piecewise(lambda piece, entries: piece.local(x[..., entries], y[..., entries]))

    def retract(self, x: Points, v: Vectors) -> Points:
        """Return the point to which a tangent vector leads."""
        tangents = iter(_slices([piece.dimension for piece in self.pieces]))
        return self._piecewise(lambda piece, entries: piece.retract(x[..., entries], v[..., next(tangents)]))

    def coordinates(self, centre: Points, y: Points) -> Vectors:
        """Return the coordinates of the pieces."""
        return self._piecewise(lambda piece, entries: piece.coordinates(centre[..., entries], y[..., entries]))

    def mean(self, weights: Weights, points: Points) -> Points:
        """Return the means of the pieces."""
        return self._piecewise(lambda piece, entries: piece.mean(weights, points[..., entries]))

    def distance(self, x: Points, y: Points) -> Numbers:
        """Return the root of the sum of the squared distances of the pieces."""
        return length(self.local(x, y))

    def log_measure(self, v: Vectors) -> Numbers:
        """Return the sum over the pieces."""
        return sum((piece.log_measure(v[..., entries]) for piece, entries in self._tangents()), 0.0 * v[..., 0])

    def images(self, v: Vectors) -> Vectors:
        """Return v, and the images of one piece at a time."""
        vectors = [v[..., None, :]]
        for piece, entries in self._tangents():
            piece_images = piece.images(v[..., entries])[..., 1:, :]
            leading, trailing = v[..., None, : entries.start], v[..., None, entries.stop :]
            same = 0 * piece_images[..., :1]
            vectors.append(joined(leading + same, piece_images, trailing + same))
        return namespace(v).concatenate(vectors, axis=-2)

    def _tangents(self) -> Iterator[tuple[Space, slice]]:
        return zip(self.pieces, _slices([piece.dimension for piece in self.pieces]), strict=True)

    def _piecewise(self, function: Callable[[Space, slice], Any]) -> Any:
        return joined(*(function(piece, entries) for piece, entries in zip(self.pieces, _slices([p.shape[0] for p in self.pieces]), strict=True)))


@dataclass(frozen=True)
class Plate:
    """Several points of one space along a leading axis, such as the placements of a body's parts, (part, 7).

    Attributes:
        names: names of the points, which precede the labels of tangent vectors.
        space: the space of each point.
        axis: name of the leading axis where points are stored; empty: it is named after the variable.
    """

    names: tuple[str, ...]
    space: Space
    axis: str = ""

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of all points together."""
        return (len(self.names), *self.space.shape)

    @property
    def axes(self) -> tuple[Axis, ...]:
        """The leading axis, and the axes of a point."""
        return (Axis(self.axis, self.names), *self.space.axes)

    @property
    def dimension(self) -> int:
        """The number of entries of a tangent vector."""
        return len(self.names) * self.space.dimension

    @property
    def tangent_labels(self) -> tuple[str, ...]:
        """The labels of the space with the name of each point, such as `torso_x`, `torso_rx`."""
        return _named(self.names, [self.space.tangent_labels] * len(self.names))

    @property
    def tangent_units(self) -> tuple[str, ...]:
        """The units of the space, for each point."""
        return self.space.tangent_units * len(self.names)

    @property
    def blocks(self) -> tuple[int, ...]:
        """Each point is a block."""
        size = len(self.space.blocks)
        return tuple(point for point in range(len(self.names)) for _ in range(size))

    def local(self, x: Points, y: Points) -> Vectors:
        """Return the tangent vectors of all points, one after the other."""
        return _flat(self.space.local(x, y))

    def retract(self, x: Points, v: Vectors) -> Points:
        """Return the points to which a tangent vector leads."""
        return self.space.retract(x, self._by_point(v))

    def coordinates(self, centre: Points, y: Points) -> Vectors:
        """Return the coordinates of all points, one after the other."""
        return _flat(self.space.coordinates(centre, y))

    def mean(self, weights: Weights, points: Points) -> Points:
        """Return the mean of each point."""
        draws = points.ndim - len(self.shape) - 1
        order = (*range(draws), draws + 1, draws, *range(draws + 2, points.ndim))
        return self.space.mean(weights[..., None, :], points.transpose(order))

    def distance(self, x: Points, y: Points) -> Numbers:
        """Return the root of the sum of the squared distances of the points."""
        return length(self.local(x, y))

    def log_measure(self, v: Vectors) -> Numbers:
        """Return the sum over the points."""
        return self.space.log_measure(self._by_point(v)).sum(axis=-1)

    def images(self, v: Vectors) -> Vectors:
        """Return v, and the images of one point at a time."""
        return Product(("",) * len(self.names), (self.space,) * len(self.names)).images(v)

    def _by_point(self, v: Vectors) -> Any:
        return v.reshape(*v.shape[:-1], len(self.names), self.space.dimension)


def _flat(vectors: Any) -> Any:
    return vectors.reshape(*vectors.shape[:-2], -1)


def _named(names: tuple[str, ...], labels: list[tuple[str, ...]]) -> tuple[str, ...]:
    return tuple(f"{name}_{label}" if name else label for name, piece_labels in zip(names, labels, strict=True) for label in piece_labels)


def _slices(sizes: list[int]) -> Iterator[slice]:
    start = 0
    for size in sizes:
        yield slice(start, start + size)
        start += size
