r"""The body's lengths as unknowns: an overall scale and a deviation of each bone, left and right alike,

$$\ell_k = \bar\ell_k \exp(x_{\mathrm{overall}} + x_{\mathrm{bone}(k)}),$$

with the mean $\bar\ell_k$ that follows from the session: from its lengths, else from the subject's height, else from the body file. The overall scale
correlates all lengths, as a person's height does. Radii do not change: `widths` changes them.

The standard deviations: human stature has a coefficient of variation of 4 to 5 % among adults of both sexes together, and a segment's share of
stature one of 4 to 5 % more (Drillis & Contini 1966; Winter 2009, 4.1, gives means only). Pelvis, clavicle, head and torso have wider ones, because
their ends are not joints that anyone sees.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.base.registry import register
from bayes_body.base.toml.schema import Finite, Positive
from bayes_body.density.factor import Variables
from bayes_body.model.body.lengths import Scaling, scaling, with_factors
from bayes_body.model.body.solids import Body
from bayes_body.model.unknowns.unknown import Setting, Unknown, UnknownSchema, deviations, unknown_about_zero

NAME, OVERALL = "lengths", "overall"
BONE_SD = {"*clavicle": 0.12, "*pelvis": 0.15, "head": 0.10, "torso": 0.08, "*": 0.06}


class Options(UnknownSchema):
    """Options of `[[unknown]] kind = "lengths"`: relative standard deviations."""

    overall_sd: Positive = 0.05
    """of all lengths together, if the session does not give the subject's height."""
    overall_sd_with_height: Positive = 0.02
    """the same if the session gives it."""
    bone_sd: Mapping[str, Positive] = {}
    """table: a length's name or a pattern = its standard deviation beside that of all lengths together; what is not named has 0.06, torso 0.08, head
    0.10, clavicles 0.12 and pelvis 0.15."""
    bone_mean: Mapping[str, Finite] = {}
    """relative; table: a bone's name or a pattern = how much longer it is expected to be than the body file says, as a logarithm. For bones that the
    session gives, it is 0."""
    sides: Literal["alike", "free"] = "alike"
    """`"alike"`: a left and a right bone have one deviation. `"free"`: each has its own."""
    lasts_s: Positive = 3600.0
    """[s] after this time an error has faded to 37 %. Bones do not change."""


def change(growth: Scaling, body: Body, value: Float[Array, " entry"], values: Variables) -> Body:
    """Return the body with its lengths changed."""
    del values
    return with_factors(body, growth, jnp.exp(value[0] + growth.groups @ value[1:]))


@register("unknown", NAME, Options)
def build(options: Options, setting: Setting, **_: Any) -> Unknown:
    """Build the unknown for one body."""
    growth, names = scaling(setting.body, setting.schema), tuple(setting.schema.lengths_of_height)
    if options.sides == "free":
        bones, growth = names, growth._replace(groups=jnp.eye(len(names), dtype=growth.groups.dtype))
    else:
        bones = tuple(dict.fromkeys(name[2:] if name.startswith(("l_", "r_")) else name for name in names))
    # A length on which nothing depends has nothing to say.
    used = np.asarray(growth.groups).T @ (np.asarray(growth.values) != 0) > 0
    growth = growth._replace(groups=growth.groups[:, np.flatnonzero(used)])
    bones = tuple(name for name, is_used in zip(bones, used, strict=True) if is_used)
    means = deviations(options.bone_mean, {"*": 0.0}, bones, "unknown 'lengths': bone_mean", "bone")
    mean = [0.0 if {name, f"l_{name}", f"r_{name}"} & setting.measured else value for name, value in zip(bones, means, strict=True)]
    overall = options.overall_sd_with_height if setting.has_height else options.overall_sd
    sd = [overall, *deviations(options.bone_sd, BONE_SD, bones, "unknown 'lengths': bone_sd", "bone")]
    prior = unknown_about_zero(NAME, (OVERALL, *bones), ("",) * len(sd), sd, options.lasts_s, setting, Body, change, growth)
    return replace(prior, mean=jnp.asarray([0.0, *mean], prior.mean.dtype))


def lengths_of(term: Unknown, values: Float[np.ndarray, "*batch entry"]) -> Float[np.ndarray, "*batch length"]:
    """Return the lengths that values of the unknown mean, metres, in the order of the body file; 0 for a length on which nothing depends."""
    growth = _growth(term)
    base, groups = np.asarray(growth.values, float), np.asarray(growth.groups, float)
    return base * np.exp(values[..., :1] + values[..., 1:] @ groups.T)


def log_sd_of(term: Unknown) -> Float[np.ndarray, " length"]:
    """Return the prior's standard deviation of the logarithm of each length."""
    variance = np.asarray(term.sd, float) ** 2
    return np.sqrt(variance[0] + np.asarray(_growth(term).groups, float) ** 2 @ variance[1:])


def _growth(term: Unknown) -> Scaling:
    change: Any = term.change
    return change.args[0]
