r"""Nodes whose sizes are not known: the value of a node is that of the plated variable, followed by its log-sizes.

A part of a body has the value $(X, \ell, w)$, with its placement, log-length and log-width. The graph's factors read it whole. Along an edge, the
placement is drawn as always, given the sizes of both nodes. The sizes of the other node are drawn from the prediction $\pi$ of the frame,

$$q(x_j \mid x_i) = \psi_{ij}(X_i, X_j; s_i, s_j)\, \mathcal N(s_j; m_j, \varsigma_j^2), \qquad s = (\ell, w),$$

so the density of a draw is the factor times that of the sizes. The factor itself says nothing about sizes alone: these have their prior once, in the
prediction.

The prediction of a size is one normal distribution, with the mean and the variance over all ancestors. A walk of sizes is so slow that each ancestor
predicts almost exactly one value for each part. Joint draws, whose parts all have one ancestor, would then be copies of the few ancestors.
"""

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from numpyro.distributions import Distribution

from bayes_body.base.shapes import Key, Scalar
from bayes_body.density.graph import Mixture
from bayes_body.density.plate import Plate
from bayes_body.density.spaces import Product, Space, euclidean


class SizeNormals(NamedTuple):
    """The predicted log-sizes: means and standard deviations; with a leading axis of nodes, of the entries of a row, or without."""

    mean: Float[Array, "*node size"]
    sd: Float[Array, "*node size"]

    def sample(self, key: Key) -> Float[Array, "*node size"]:
        """Draw log-sizes."""
        return self.mean + self.sd * jax.random.normal(key, self.mean.shape, self.mean.dtype)

    def log_prob(self, log_sizes: Float[Array, " size"]) -> Scalar:
        """Return the log-density of log-sizes of one node."""
        z = (log_sizes - self.mean) / self.sd
        return jnp.sum(-0.5 * z * z - jnp.log(self.sd) - 0.5 * math.log(2 * math.pi))


def size_normals(predictions: list[Distribution], log_weights: Float[Array, " particle"]) -> SizeNormals:
    """Return the mean and the standard deviation of each node's log-sizes over all ancestors.

    Args:
        predictions: for each size, the distributions of all nodes given each ancestor, independent normal ones.
        log_weights: normalised log-weights of the ancestors.
    """
    weights = jnp.exp(log_weights)[:, None]

    def moments(prediction: Any) -> tuple[Array, Array]:
        means, variances = jax.vmap(lambda of_ancestor: (jnp.asarray(of_ancestor.mean), jnp.asarray(of_ancestor.variance)))(prediction)
        mean = jnp.sum(weights * means, axis=0)
        return mean, jnp.sqrt(jnp.sum(weights * (variances + (means - mean) ** 2), axis=0))

    means, sds = zip(*map(moments, predictions), strict=True)
    return SizeNormals(jnp.stack(means, axis=-1), jnp.stack(sds, axis=-1))


def sized_space(space: Space, names: tuple[str, ...]) -> Product:
    """Return the space of a node's value and its log-sizes."""
    return Product(("", ""), (space, euclidean(names, ("",) * len(names))))


@partial(jax.tree_util.register_dataclass, meta_fields=[], data_fields=["entry", "sizes"])
@dataclass(frozen=True)
class SizedEntry:
    """A distribution of a node's value and of its log-sizes, which are independent.

    Attributes:
        entry: the distribution of the value.
        sizes: that of the log-sizes.
    """

    entry: Any
    sizes: SizeNormals

    def sample(self, key: Key) -> Array:
        """Draw a value with its log-sizes."""
        entry_key, size_key = jax.random.split(key)
        return jnp.concatenate([self.entry.sample(entry_key), self.sizes.sample(size_key)])

    def log_prob(self, x: Array) -> Scalar:
        """Return the log-density."""
        count = self.sizes.mean.shape[-1]
        return self.entry.log_prob(x[:-count]) + self.sizes.log_prob(x[-count:])

    def log_prob_of_pairs(self, values: Float[Array, "value entry"]) -> Float[Array, "value component"]:
        """Return the log-densities of all values under each of many components, whose fields are stacked."""
        count = self.sizes.mean.shape[-1]
        places = values[:, :-count]
        if hasattr(self.entry, "log_prob_of_pairs"):
            of_entry = self.entry.log_prob_of_pairs(places)
        else:
            of_entry = jax.vmap(lambda x: jax.vmap(lambda component: jnp.asarray(component.log_prob(x)))(self.entry))(places)
        return of_entry + jax.vmap(lambda log_sizes: jax.vmap(lambda sizes: sizes.log_prob(log_sizes))(self.sizes))(values[:, -count:])


def sized_mixture(mixture: Mixture, sizes: SizeNormals) -> Mixture:
    """Return the mixtures of all nodes with the log-sizes of the nodes beside their values."""
    components = mixture.log_weights.shape[1]
    spread = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf[:, None], (leaf.shape[0], components, leaf.shape[1])), sizes)
    return Mixture(SizedEntry(mixture.components, spread), mixture.log_weights)


# -- factors ----------------------------------------------------------------------------------------------------------------------------


class SizedRow(NamedTuple):
    """The parameters of a row, and the predicted log-sizes of its entries."""

    parameters: Any
    sizes: SizeNormals


@partial(jax.tree_util.register_dataclass, meta_fields=["names"], data_fields=["plate"])
@dataclass(frozen=True)
class SizedPlate:
    """The functions of a plate for entries that are followed by their log-sizes.

    Attributes:
        names: the names of all sizes, in the order of the entries.
        plate: the plate, without parameters.
    """

    names: tuple[str, ...]
    plate: Plate

    def log_potential(self, row: SizedRow, *entries: Array, **data: Any) -> Scalar:
        """Return the log-potential of a row."""
        return self.plate.log_potential(self._resized(row, *entries), *map(self._place, entries), **data)

    def pairwise(self, row: SizedRow, first: Float[Array, "first entry"], second: Float[Array, "second entry"]) -> Float[Array, "first second"]:
        """Return the log-potentials of all pairs. They depend on the size of the first entry alone."""
        evaluate, places = self.plate.pairwise, self._place(second)
        assert evaluate is not None
        return jax.vmap(lambda x: evaluate(self._resized(row, x, second[0]), self._place(x)[None], places)[0])(first)

    def draw(self, key: Key, row: SizedRow, source: Array, reverse: bool) -> Array:
        """Draw the log-sizes of the target entry from their prediction, and given these its value along the edge."""
        draw_along = self.plate.draw
        assert draw_along is not None
        size_key, key = jax.random.split(key)
        sizes = self._of_target(row, reverse).sample(size_key)
        # Only its sizes are read.
        target = jnp.concatenate([self._place(source), sizes])
        entries = (target, source) if reverse else (source, target)
        return jnp.concatenate([draw_along(key, self._resized(row, *entries), self._place(source), reverse), sizes])

    def log_draw(self, row: SizedRow, source: Array, target: Array, reverse: bool) -> Scalar:
        """Return the log-density of `draw`, where the plate has a density of its own for that."""
        log_density = self.plate.log_draw
        assert log_density is not None
        entries = (target, source) if reverse else (source, target)
        return log_density(self._resized(row, *entries), self._place(source), self._place(target), reverse) + self.log_beside(row, target, reverse)

    def log_beside(self, row: SizedRow, target: Array, reverse: bool) -> Scalar:
        """Return the log-density of the log-sizes that `draw` gives the target entry."""
        return self._of_target(row, reverse).log_prob(target[-len(self.names) :])

    def _resized(self, row: SizedRow, *entries: Array) -> Any:
        parameters = row.parameters
        for name in self.plate.sizes:
            column = self.names.index(name) - len(self.names)
            parameters = self.plate.resize[name](parameters, *(entry[column] for entry in entries))
        return parameters

    def _place(self, entry: Float[Array, "*value entry"]) -> Float[Array, "*value place"]:
        return entry[..., : -len(self.names)]

    def _of_target(self, row: SizedRow, reverse: bool) -> SizeNormals:
        return jax.tree.map(lambda leaf: leaf[0 if reverse else 1], row.sizes)


def sized_plate(plate: Plate, names: tuple[str, ...], sizes: SizeNormals) -> Plate:
    """Return a plate for entries that are followed by their log-sizes.

    Args:
        plate: the plate. If it reads no sizes, they are left out.
        names: the names of all sizes, in the order of the entries.
        sizes: the predicted log-sizes of all nodes.
    """
    functions = SizedPlate(names, replace(plate, parameters=None))
    rows = jnp.asarray(plate.rows, int)
    offered: dict[str, Any] = {}
    if plate.draw is not None:
        offered["draw"] = jax.tree_util.Partial(SizedPlate.draw, functions)
        beside = "log_beside" if plate.log_draw is None else "log_draw"
        offered[beside] = jax.tree_util.Partial(getattr(SizedPlate, beside), functions)
    if plate.pairwise is not None:
        offered["pairwise"] = jax.tree_util.Partial(SizedPlate.pairwise, functions)
    row = SizedRow(plate.parameters, jax.tree.map(lambda leaf: leaf[rows], sizes))
    return Plate(plate.variable, plate.rows, jax.tree_util.Partial(SizedPlate.log_potential, functions), row, **offered)
