r"""How a body changes with its lengths.

A body is affine in its lengths: the offsets of joints, markers and parts are constants plus named lengths with a sign. To find the contribution of a
length, the body is built with that length alone. Radii do not depend on lengths.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.base.geometry.namespaces import device_array
from bayes_body.model.body.build import Shape, build_body
from bayes_body.model.body.schema import BodySchema
from bayes_body.model.body.solids import Body


class Fields(NamedTuple):
    """The arrays of a body that depend on its lengths, metres; in `Scaling.contributions`, with a leading axis of lengths."""

    joints: Float[Array, "*length joint 3"]
    markers: Float[Array, "*length marker 3"]
    parts: Float[Array, "*length part 3"]
    lengths: Float[Array, "*length part"]


class Scaling(NamedTuple):
    """How a body changes with its lengths.

    Attributes:
        values: the body's lengths, metres; empty if they are not fitted.
        groups: how much the logarithm of a length (row) changes with a parameter (column); 1 where it is its own.
        contributions: what each length adds to the body's arrays.
    """

    values: Float[Array, " length"]
    groups: Float[Array, "length group"]
    contributions: Fields


def fixed(body: Body) -> Scaling:
    """Return the scaling of a body with constant lengths: it has no parameters."""
    no_fields = jax.tree.map(lambda leaf: device_array(np.zeros((0, *leaf.shape)), leaf.dtype), fields(body))
    dtype = body.lengths.dtype
    return Scaling(device_array(np.zeros(0), dtype), device_array(np.zeros((0, 0)), dtype), no_fields)


def scaling(body: Body, schema: BodySchema) -> Scaling:
    """Return the scaling in which all lengths of a body are parameters; left and right share one."""
    names = tuple(schema.lengths_of_height)
    no_lengths = dict.fromkeys(names, 0.0)
    constant = _flat(build_body(body.name, schema, Shape(1.0, no_lengths)))
    rows = np.stack([_flat(build_body(body.name, schema, Shape(1.0, no_lengths | {name: 1.0}))) - constant for name in names])
    # The lengths with which this body was built; a length on which nothing depends is 0 here.
    values = np.linalg.lstsq(rows.T, _flat(body) - constant, rcond=None)[0]
    dtype = body.lengths.dtype
    return Scaling(jnp.asarray(values, dtype), jnp.asarray(_groups(names), dtype), _unflat(values[:, None] * rows, body))


def with_factors(body: Body, change: Scaling, factors: Float[Array, " length"]) -> Body:
    """Return the body with its lengths multiplied by factors."""
    growth = factors - 1
    scaled_fields = jax.tree.map(lambda base, contribution: base + jnp.tensordot(growth, contribution, 1), fields(body), change.contributions)
    skeleton, markers = replace(body.skeleton, offsets=scaled_fields.joints), replace(body.markers, offsets=scaled_fields.markers)
    return replace(body, skeleton=skeleton, markers=markers, offsets=scaled_fields.parts, lengths=scaled_fields.lengths)


def fields(body: Body) -> Fields:
    """Return the arrays of a body that depend on its lengths."""
    return Fields(body.skeleton.offsets, body.markers.offsets, body.offsets, body.lengths)


def _flat(body: Body) -> Float[np.ndarray, " entry"]:
    return np.concatenate([np.asarray(field, float).ravel() for field in fields(body)])


def _unflat(rows: Float[np.ndarray, "length entry"], body: Body) -> Fields:
    shapes = fields(body)
    cuts = np.cumsum([field.size for field in shapes])[:-1]
    pieces = np.split(rows, cuts, axis=1)
    return Fields(*(jnp.asarray(piece.reshape(-1, *field.shape), field.dtype) for piece, field in zip(pieces, shapes, strict=True)))


def _groups(names: tuple[str, ...]) -> Float[np.ndarray, "length group"]:
    stems = [name[2:] if name.startswith(("l_", "r_")) else name for name in names]
    kinds = list(dict.fromkeys(stems))
    return np.array([[float(stem == kind) for kind in kinds] for stem in stems])
