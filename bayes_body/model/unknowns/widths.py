r"""The widths of the body's parts as unknowns: the radii of each part, for the solids and for what cameras see, are multiplied by $e^x$.

Of a body that is placed by parts, each part has a width of its own (model/unknowns/part_sizes.py).
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from bayes_body.base.registry import register
from bayes_body.base.toml.schema import Positive
from bayes_body.density.factor import Variables
from bayes_body.model.body.placement import ByParts
from bayes_body.model.body.solids import Body
from bayes_body.model.unknowns.part_sizes import part_stems, size_of_parts, widened
from bayes_body.model.unknowns.unknown import Setting, Unknown, UnknownSchema, deviations, unknown_about_zero

NAME = "widths"
FIELD, USUAL = "unknown 'widths': sd", {"*": 0.1}


class Options(UnknownSchema):
    """Options of `[[unknown]] kind = "widths"`: relative standard deviations of the parts' radii, left and right alike. Parts are free."""

    sd: Mapping[str, Positive] = {}
    """table: a part's name without `l_` and `r_`, or a pattern = the standard deviation of its radii; what is not named has 0.1."""
    lasts_s: Positive = 60.0
    """[s] after this time an error has faded to 37 %. Clothes move."""


def change(kinds: Int[Array, " part"], body: Body, value: Float[Array, " entry"], values: Variables) -> Body:
    """Return the body with its radii changed."""
    del values
    growth = jnp.exp(value[kinds])[:, None]
    return replace(body, radii=growth * body.radii, outline_radii=growth * body.outline_radii)


@register("unknown", NAME, Options)
def build(options: Options, setting: Setting, **_: Any) -> Unknown:
    """Build the unknown for one body."""
    if isinstance(setting.body.placement, ByParts):
        stems = part_stems(setting.body.placement)
        sd = deviations(options.sd, USUAL, stems, FIELD, "part")
        return size_of_parts(NAME, sd, options.lasts_s, setting, widened)
    stems = [name[2:] if name.startswith(("l_", "r_")) else name for name in setting.body.topology.names]
    kinds = tuple(dict.fromkeys(stems))
    index = jnp.asarray(np.array([kinds.index(stem) for stem in stems], np.int32))
    sd = deviations(options.sd, USUAL, kinds, FIELD, "part")
    return unknown_about_zero(NAME, kinds, ("",) * len(kinds), sd, options.lasts_s, setting, Body, change, index)
