r"""Parts of a loose-limbed body do not penetrate each other: a plate over pairs of parts (Sigal et al. 2011, (7)).

With spheres along the axes of the solids that two parts hold, and $d$ the depth of the deepest pair of spheres minus the depth by which flesh yields,

$$\log \psi = -\infty \text{ if } d > 0 \quad (\text{hard}), \qquad \log \psi = -\tfrac12 \big(\max(d, 0) / \sigma\big)^2 \quad (\text{soft}).$$

The constraint `intersection` says the same of a whole body at once, for both placements. Here each pair is a factor of its own, which message passing
needs. It is a constraint, so it applies at full power at every temperature.
"""

from collections.abc import Mapping
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.base.config import FAST_COMPILE
from bayes_body.base.errors import InputError, input_error, nearest
from bayes_body.base.geometry import rigid
from bayes_body.base.geometry.namespaces import device_array
from bayes_body.base.registry import register
from bayes_body.base.shapes import Scalar
from bayes_body.base.toml.schema import NonNegative, Positive, Schema
from bayes_body.density.factor import Factor
from bayes_body.density.plate import Plate, plate_factor
from bayes_body.model.body.placed_body import require, solids_in_parts
from bayes_body.model.body.placement import LENGTHS, PARTS, WIDTHS, ByParts
from bayes_body.model.body.solids import Body, Spheres, sphere_approximation


class Options(Schema):
    """Options of `[[potential]] kind = "penetration"`. Without `pairs`, the body's own list of pairs is tested."""

    mode: Literal["hard", "soft"] = "soft"
    """`"hard"` forbids penetration; `"soft"` is a half-Gaussian in the depth, for kernels that need a gradient."""
    yield_m: NonNegative = 0.03
    """[metres] allowed depth."""
    soft_sd_m: Positive = 0.01
    """[metres] with `"soft"`: standard deviation of the depth beyond that."""
    pairs: tuple[tuple[str, str], ...] | None = None
    """pairs of solids, such as `[["l_calf", "r_calf"]]`; without it, those of the body's `penetration`."""


def depth(pair: Mapping[str, Array], first: Float[Array, "7"], second: Float[Array, "7"]) -> Scalar:
    """Return the depth of the deepest pair of spheres of two parts, beyond what flesh yields, metres; negative if they are apart."""
    a = rigid.apply(first[None], pair["centres"][0])[:, None]
    b = rigid.apply(second[None], pair["centres"][1])[None]
    # sqrt of a clamped square: its gradient at coinciding centres would be infinite.
    distance = jnp.sqrt(jnp.maximum(jnp.sum((a - b) ** 2, axis=-1), 1e-12))
    return jnp.max(pair["radii"][0][:, None] + pair["radii"][1][None] - distance) - pair["yields"]


def _hard(pair: Mapping[str, Array], first: Float[Array, "7"], second: Float[Array, "7"]) -> Scalar:
    return jnp.where(depth(pair, first, second) > 0, -jnp.inf, 0.0)


def _soft(pair: Mapping[str, Array], first: Float[Array, "7"], second: Float[Array, "7"]) -> Scalar:
    return -0.5 * (jnp.maximum(depth(pair, first, second), 0.0) / pair["soft_sd"]) ** 2


def _stretched(pair: Mapping[str, Array], *log_lengths: Scalar) -> dict[str, Array]:
    return {**pair, "centres": jnp.exp(jnp.stack(log_lengths))[:, None, None] * pair["centres"]}


def _widened(pair: Mapping[str, Array], *log_widths: Scalar) -> dict[str, Array]:
    return {**pair, "radii": jnp.exp(jnp.stack(log_widths))[:, None] * pair["radii"]}


@register("potential", "penetration", Options)
def build(name: str, options: Options, body: Body, **_: Any) -> Factor:
    """Build the plate for a loose-limbed body.

    Raises:
        InputError: the body is placed by angles, or it lacks a part of a pair.
    """
    require(body, PARTS, "potential 'penetration'", "the constraint 'intersection'")
    rows = _rows(name, options, body)
    centres, radii = _spheres(body)
    dtype = body.lengths.dtype
    chosen = np.array(rows)
    parameters = {
        "centres": device_array(centres[chosen], dtype),
        "radii": device_array(radii[chosen], dtype),
        "yields": device_array(np.full(len(rows), options.yield_m), dtype),
        "soft_sd": device_array(np.full(len(rows), options.soft_sd_m), dtype),
    }
    log_potential = jax.tree_util.Partial(_hard if options.mode == "hard" else _soft)
    resize = {LENGTHS: jax.tree_util.Partial(_stretched), WIDTHS: jax.tree_util.Partial(_widened)}
    return plate_factor(name, "constraint", Plate(PARTS, rows, log_potential, parameters, resize=resize))


def _rows(name: str, options: Options, body: Body) -> tuple[tuple[int, ...], ...]:
    """Return the pairs of parts. Pairs of solids that one part holds cannot move against each other and are left out."""
    placement = body.placement
    assert isinstance(placement, ByParts)
    holder = {solid: placement.owners[joint] for solid, joint in zip(body.topology.names, body.topology.joints, strict=True)}
    for first, second in options.pairs or ():
        for part in (first, second):
            if part not in holder:
                raise InputError(f"{name}: pairs: '{part}' is no part of the body '{body.name}'; {nearest(part, holder)}")
    names = body.topology.names
    pairs = options.pairs if options.pairs is not None else [(names[a], names[b]) for a, b in body.topology.penetration]
    rows = tuple(dict.fromkeys((holder[a], holder[b]) for a, b in pairs if holder[a] != holder[b]))
    if not rows:
        raise input_error(name, "no pair of parts to test", "at least one", "give pairs, or take the potential out")
    return rows


@jax.jit(compiler_options=FAST_COMPILE)
def _in_parts(body: Body) -> Spheres:
    """Return the spheres of all solids, in the frame of the part that holds them."""
    return sphere_approximation(body, solids_in_parts(body))


def _spheres(body: Body) -> tuple[Float[np.ndarray, "part sphere 3"], Float[np.ndarray, "part sphere"]]:
    """Return the spheres of all solids that each part holds, in its frame. Parts with fewer repeat their first one."""
    placement = body.placement
    assert isinstance(placement, ByParts)
    solid_spheres = _in_parts(body)
    holders = np.array([placement.owners[joint] for joint in body.topology.joints])
    solids_by_part = [np.flatnonzero(holders == part) for part in range(len(placement.names))]
    centres, radii = ([np.concatenate(np.asarray(values, float)[solids]) for solids in solids_by_part] for values in solid_spheres)
    most = max(len(part_radii) for part_radii in radii)

    def filled(values: np.ndarray) -> np.ndarray:
        return np.concatenate([values, np.repeat(values[:1], most - len(values), axis=0)])

    return np.stack([filled(c) for c in centres]), np.stack([filled(r) for r in radii])
