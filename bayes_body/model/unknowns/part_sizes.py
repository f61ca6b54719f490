r"""Sizes of the parts of a body that is placed by parts: each part has a log-length and a log-width of its own.

With the log-length x of a part, all places in its frame are multiplied by $e^x$: its solids with their lengths, its markers, and where other parts
are attached. So the shoulders lie further apart on a longer torso. Its log-width multiplies the radii of its solids. A part's own joint is the origin
of its frame, and stays.

A part does not know its neighbours' sizes: they are independent in the prior, left and right too. What says that they are alike is the images.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.density.factor import Variables
from bayes_body.model.body.placement import ByParts
from bayes_body.model.body.solids import Body
from bayes_body.model.unknowns.unknown import Setting, Unknown, unknown_about_zero


def part_stems(placement: ByParts) -> tuple[str, ...]:
    """Return the names of the parts without `l_` and `r_`."""
    return tuple(name[2:] if name.startswith(("l_", "r_")) else name for name in placement.names)


def size_of_parts(name: str, sd: list[float], lasts_s: float, setting: Setting, change: Callable[..., Body]) -> Unknown:
    """Return an unknown with one entry for each part.

    Args:
        name: the variable.
        sd: the standard deviation of each part's log-size.
        lasts_s: after this time an error has faded to 37 %, seconds.
        setting: what it is built for.
        change: `(body, value, variables) -> body`.
    """
    placement = setting.body.placement
    assert isinstance(placement, ByParts)
    return unknown_about_zero(name, placement.names, ("",) * len(sd), sd, lasts_s, setting, Body, change)


def stretched(body: Body, value: Float[Array, " part"], values: Variables) -> Body:
    """Return the body with the lengths of its parts changed."""
    del values
    placement: Any = body.placement
    factors, owners = jnp.exp(value), np.array(placement.owners)
    of_solids = factors[owners[np.array(body.topology.joints)]]
    parents = np.array(body.skeleton.topology.parents)
    # A joint is placed in the frame of the joint above it; the first joint's place is not a length of the body.
    of_joints = jnp.where(parents >= 0, factors[owners[np.maximum(parents, 0)]], 1.0)
    inside = placement.T_part_joint
    return replace(
        body,
        placement=replace(placement, T_part_joint=inside._replace(origin=factors[owners][:, None] * inside.origin)),
        skeleton=replace(body.skeleton, offsets=of_joints[:, None] * body.skeleton.offsets),
        markers=replace(body.markers, offsets=factors[owners[np.array(body.markers.joints)]][:, None] * body.markers.offsets),
        offsets=of_solids[:, None] * body.offsets,
        lengths=of_solids * body.lengths,
    )


def widened(body: Body, value: Float[Array, " part"], values: Variables) -> Body:
    """Return the body with the widths of its parts changed."""
    del values
    placement: Any = body.placement
    factors = jnp.exp(value)[np.array(placement.owners)[np.array(body.topology.joints)]][:, None]
    return replace(body, radii=factors * body.radii, outline_radii=factors * body.outline_radii)
