r"""Draws from products of messages by Gibbs sampling of component labels (Sudderth et al. 2003; Sigal et al. 2011, 7.2).

A message is $\sum_n w^{(n)} \psi(x^{(n)}, x)$. In the product of several, a label $l_k$ says which particle of message k a point comes from:

$$p(x, l_1 \ldots l_K) \propto \prod_k w_k^{(l_k)}\, \psi_k\big(x_k^{(l_k)}, x\big).$$

Given x, the labels are independent and drawn exactly. Given the labels, x is proposed from the product of normal distributions that stand for the
factors $\psi_k(x_k^{(l_k)}, \cdot)$, and accepted by Metropolis-Hastings. The papers have no such step. Without it, draws are biased where a factor
is curved in the target's tangent space, as in a message from a child to its parent. The mean of a normal distribution is the mean of a few draws
along the edge; its covariance is the covariance of such draws, averaged over the message's particles. A chain begins with a draw from one message, so
for a product of one message it is exact from the start.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from bayes_body.base.shapes import Key
from bayes_body.density.graph import Graph, Term
from bayes_body.density.spaces import Space
from bayes_body.density.tangent_normal import TangentNormal
from bayes_body.kernels.batching import ROWS, over_particles
from bayes_body.kernels.messages.messages import slots, without_nan

# Sweeps of a chain: the paper takes 5 to 10.
SWEEPS = 8
# Draws for the mean and the covariance of a factor.
DRAWS = 8


class Way(NamedTuple):
    """The messages of one term in one direction, for terms that propose."""

    term: Term
    reverse: bool
    targets: np.ndarray


class Product(NamedTuple):
    """Messages, in the order of `ways`, into some nodes; and which of them each sample multiplies.

    Attributes:
        rows: for each way, the rows of its term whose messages these are.
        points: particles of the source of every message.
        weights: their normalised log-weights.
        targets: for every message, which of the nodes it goes to.
        slots: which messages go into each node; anything where none is taken.
        taken: for every sample, whether the message of a slot is a factor of its product.
    """

    rows: tuple[Int[Array | np.ndarray, "_"], ...]
    points: Float[Array, "message source *entry"]
    weights: Float[Array, "message source"]
    targets: Int[Array | np.ndarray, " message"]
    slots: Int[Array | np.ndarray, "node slot"]
    taken: Float[Array, "node sample slot"]


def ways(graph: Graph) -> list[Way]:
    """Return all messages along which values are proposed: by term, first those to the second node of a row."""
    able = [term for term in graph.pairs if term.plate.draw is not None]
    return [Way(term, reverse, term.rows[:, 0 if reverse else 1]) for term in able for reverse in (False, True)]


def slots_of(graph: Graph) -> Int[np.ndarray, "node slot"]:
    """Return the numbers of the messages into each node, in the order of `ways`; the number after the last is padding."""
    return slots(np.concatenate([way.targets for way in ways(graph)] or [np.zeros(0, int)]), graph.count)


def draw_products(key: Key, graph: Graph, product: Product, otherwise: Float[Array, "node sample *entry"]) -> Float[Array, "node sample *entry"]:
    """Return one draw from every sample's product, or the value of `otherwise` if the product has no factors."""
    label_key, start_key, normal_key, key = jax.random.split(key, 4)
    samples, has_product = otherwise.shape[1], jnp.max(product.taken, axis=2) > 0
    first = jnp.argmax(product.taken, axis=2)
    labels = jax.vmap(lambda key, w: jax.random.categorical(key, w, shape=(samples,)))(
        jax.random.split(label_key, len(product.weights)), product.weights
    )
    start = _into(product, _drawn(start_key, graph, product, labels))
    start = jnp.take_along_axis(start, first.reshape(*first.shape, 1, *[1] * (start.ndim - 3)), axis=2)[:, :, 0]
    shape = has_product.reshape(*has_product.shape, *[1] * (otherwise.ndim - 2))
    normals = _normals(normal_key, graph, product)

    def sweep(x: Array, key: Key) -> tuple[Array, None]:
        label_key, step_key, accept_key = jax.random.split(key, 3)
        chosen = _labels(label_key, graph, product, x)
        proposal = _proposal(graph.space, product, normals, chosen)
        log_ratio = _log_factors(graph, product, chosen, x)
        proposed = jax.vmap(jax.vmap(lambda key, normal: normal.sample(key)))(jax.random.split(step_key, x.shape[:2]), proposal)
        log_ratio = _log_factors(graph, product, chosen, proposed) - log_ratio + _density(proposal, x) - _density(proposal, proposed)
        accepted = jnp.log(jax.random.uniform(accept_key, log_ratio.shape)) < log_ratio
        return jnp.where(accepted.reshape(shape.shape) & shape, proposed, x), None

    return jax.lax.scan(sweep, jnp.where(shape, start, otherwise), jax.random.split(key, SWEEPS))[0]


def _density(proposal: TangentNormal, x: Array) -> Float[Array, "node sample"]:
    return jax.vmap(jax.vmap(lambda normal, point: normal.log_prob(point)))(proposal, x)


def _per_message(graph: Graph, product: Product, function: Callable[..., Array], *arrays: Array) -> Array:
    """Return `function(way, row's parameters, entries of the arrays, by message)` of all messages, stacked."""
    results, start = [], 0
    for way, rows in zip(ways(graph), product.rows, strict=True):
        parameters = jax.tree.map(lambda leaf, rows=rows: leaf[rows], way.term.plate.parameters)
        messages = slice(start, start + len(rows))
        results.append(_by_row(way, function, (parameters, *[array[messages] for array in arrays])))
        start += len(rows)
    return jnp.concatenate(results)


def _by_row(way: Way, function: Callable[..., Array], arrays: tuple[Any, ...]) -> Array:
    """Return the values of a function of one message for all of them. One message is enough work for a core."""

    def of_message(entries: tuple[Any, ...], term: Term) -> Array:
        return function(way._replace(term=term), *entries)

    # Draws may reject in a loop, in which JAX cannot check which values differ between devices.
    return over_particles(of_message, arrays, way.term, ROWS, checked=False)


def _into(product: Product, values: Float[Array, "message sample *any"]) -> Float[Array, "node sample slot *any"]:
    """Return values of messages by node, sample and slot. Padding has the values of any message."""
    return jnp.moveaxis(values[jnp.minimum(product.slots, len(values) - 1)], 1, 2)


def _drawn(key: Key, graph: Graph, product: Product, labels: Int[Array, "message sample"]) -> Float[Array, "message sample *entry"]:
    """Return one draw along the edge from each labelled particle."""

    def along_edge(way: Way, parameters: Any, keys: Array, points: Array, labels: Array) -> Array:
        draw = way.term.plate.draw
        assert draw is not None
        return jax.vmap(lambda key, source_point: draw(key, parameters, source_point, way.reverse))(keys, points[labels])

    return _per_message(graph, product, along_edge, jax.random.split(key, labels.shape), product.points, labels)


def _normals(key: Key, graph: Graph, product: Product) -> tuple[Float[Array, "message source *entry"], Float[Array, "message dimension dimension"]]:
    """Return the mean of each particle's factor, and the precision of the factors of each message."""
    space, (messages, count) = graph.space, product.weights.shape
    every = jnp.tile(jnp.arange(count), (messages, DRAWS))
    drawn = _drawn(key, graph, product, every).reshape(messages, DRAWS, count, *product.points.shape[2:])
    mean = space.retract(drawn[:, 0], jnp.mean(jnp.asarray(space.local(drawn[:, :1], drawn)), axis=1))
    v = jnp.asarray(space.local(jnp.asarray(mean)[:, None], drawn))
    covariance = jnp.einsum("ms,mrsi,mrsj->mij", jnp.exp(product.weights), v, v) / (DRAWS - 1)
    return jnp.asarray(mean), jnp.linalg.inv(covariance + 1e-10 * jnp.eye(v.shape[-1], dtype=v.dtype))


def _proposal(space: Space, product: Product, normals: tuple[Array, Array], labels: Int[Array, "message sample"]) -> TangentNormal:
    """Return, for each sample, the product of the normal distributions that its labels choose."""
    means = _into(product, jax.vmap(lambda message_means, chosen: message_means[chosen])(normals[0], labels))
    precision = normals[1][jnp.minimum(product.slots, len(labels) - 1)]
    first = jnp.argmax(product.taken, axis=2)
    reference = jnp.take_along_axis(means, first.reshape(*first.shape, 1, *[1] * (means.ndim - 3)), axis=2)[:, :, 0]
    v = jnp.asarray(space.local(reference[:, :, None], means))
    total = jnp.einsum("nsk,nkij->nsij", product.taken, precision)
    total = jnp.where(jnp.max(product.taken, axis=2)[..., None, None] > 0, total, jnp.eye(v.shape[-1], dtype=v.dtype))
    shift = jnp.einsum("nsk,nkij,nskj->nsi", product.taken, precision, v)
    covariance = jnp.linalg.inv(total)
    root = jnp.linalg.cholesky(0.5 * (covariance + jnp.swapaxes(covariance, 2, 3)))
    mean = space.retract(reference, jnp.einsum("nsij,nsj->nsi", covariance, shift))
    return TangentNormal(space, jnp.asarray(mean), root, jnp.linalg.inv(root))


def _labels(key: Key, graph: Graph, product: Product, x: Float[Array, "node sample *entry"]) -> Int[Array, "message sample"]:
    """Draw the labels of all messages given the points."""

    def draw_labels(way: Way, parameters: Any, key: Key, points: Array, weights: Array, target: Array) -> Array:
        pairs = way.term.pairwise(parameters, target, points).T if way.reverse else way.term.pairwise(parameters, points, target)
        log_weights = without_nan(pairs) + weights[:, None]
        cumulative = jnp.cumsum(jnp.exp(log_weights - jnp.max(log_weights, axis=0)), axis=0)
        level = jax.random.uniform(key, cumulative.shape[1:]) * cumulative[-1]
        return jnp.minimum(jnp.sum(cumulative <= level, axis=0), len(points) - 1)

    keys = jax.random.split(key, len(product.weights))
    return _per_message(graph, product, draw_labels, keys, product.points, product.weights, x[product.targets])


def _log_factors(
    graph: Graph, product: Product, labels: Int[Array, "message sample"], x: Float[Array, "node sample *entry"]
) -> Float[Array, "node sample"]:
    """Return the sum of the log-factors that the labels choose, at the points."""

    def log_factors(way: Way, parameters: Any, points: Array, labels: Array, target: Array) -> Array:
        log_potential = way.term.log_potential
        turned = (
            (lambda source_point, point: log_potential(parameters, point, source_point))
            if way.reverse
            else (lambda source_point, point: log_potential(parameters, source_point, point))
        )
        return jax.vmap(turned)(points[labels], target)

    values = _into(product, _per_message(graph, product, log_factors, product.points, labels, x[product.targets]))
    return jnp.sum(jnp.where(product.taken > 0, values, 0.0), axis=2)
