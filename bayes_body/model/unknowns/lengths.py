r"""The body's lengths as unknowns: an overall scale and a deviation of each bone, left and right alike,

$$\ell_k = \bar\ell_k \exp(x_{\mathrm{overall}} + x_{\mathrm{bone}(k)}),$$

with the mean $\bar\ell_k$ that follows from the session: from its lengths, else from the subject's height, else from the body file. A session may say
how well it knows a length (`lengths_sd`), and how much of this all lengths have in common (`overall`). Radii do not change: `widths` changes them.

The overall scale is that of the stature, and a bone's deviation that of its share of the stature. Their standard deviations and the correlations of
the shares are those of 187 measured people (models/learned/bone_lengths.toml). A long thigh goes with a short torso, -0.45, because the stature is
their sum. A given height leaves the shares as uncertain as they were. Means are the body file's, because measured landmarks are not the joints'
centres; the standard deviations count this too.

The entries of the value are independent, so that all kernels see what they know. With the symmetric root of the correlations R,

$$x_{\mathrm{bones}} = D R^{1/2} D^{-1} z, \qquad z \sim \mathcal N(0, D^2), \qquad \operatorname{cov} x_{\mathrm{bones}} = D R D.$$

Reports show x, by the names of the bones.

Of a body that is placed by parts, each part has a length of its own, $\ell_i = \bar\ell_i e^{x_i}$ with the variance of both deviations together
(model/unknowns/part_sizes.py). One number for all parts would be a factor of all nodes of the graph.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.base.errors import InputError, input_error, nearest
from bayes_body.base.registry import register
from bayes_body.base.toml.schema import Finite, NonNegative, Positive
from bayes_body.density.factor import Variables
from bayes_body.model.body.lengths import Scaling, scaling, with_factors
from bayes_body.model.body.placement import ByParts
from bayes_body.model.body.solids import Body
from bayes_body.model.unknowns.part_sizes import part_stems, size_of_parts, stretched
from bayes_body.model.unknowns.people import bone_variation, symmetric_root
from bayes_body.model.unknowns.unknown import Setting, Unknown, UnknownSchema, centred, deviations, unknown_about_zero

NAME, OVERALL = "lengths", "overall"
# Of bones that were not measured.
OTHER_SD = 0.06
# The largest share of the smallest standard deviation of a length in a session that all lengths have in common.
MOST_COMMON = 0.95


class Options(UnknownSchema):
    """Options of `[[unknown]] kind = "lengths"`: relative standard deviations."""

    overall_sd: Positive = 0.055
    """of all lengths together, if the session does not give the subject's height."""
    overall_sd_with_height: Positive = 0.015
    """the same if the session gives it. Heights that people tell are wrong by this much."""
    bone_sd: Mapping[str, NonNegative] = {}
    """table: a length's name or a pattern = its standard deviation beside that of all lengths together, in place of the learned one. Correlations
    stay. Learned ones are 0.045 to 0.065 for limbs, hands and feet, torso 0.07, head 0.09, heels 0.10, clavicles 0.11 and pelvis 0.14; a length that
    is none of these has 0.06. With 0, a length is known but for the overall scale. Of a body placed by parts, the names are those of parts
    without `l_` and `r_`."""
    bone_mean: Mapping[str, Finite] = {}
    """relative; table: a bone's name or a pattern = how much longer it is expected to be than the body file says, as a logarithm. For bones that the
    session gives, it is 0."""
    sides: Literal["alike", "free"] = "alike"
    """`"alike"`: a left and a right bone have one deviation. `"free"`: each has its own, without correlations. Parts are always free."""
    lasts_s: Positive = 3600.0
    """[s] after this time an error has faded to 37 %. Bones do not change."""


def change(growth: Scaling, body: Body, value: Float[Array, " entry"], values: Variables) -> Body:
    """Return the body with its lengths changed."""
    del values
    return with_factors(body, growth, jnp.exp(value[0] + growth.groups @ value[1:]))


@register("unknown", NAME, Options)
def build(options: Options, setting: Setting, **_: Any) -> Unknown:
    """Build the unknown for one body.

    Raises:
        InputError: a key matches no bone, or a bone that is known has another mean.
    """
    if isinstance(setting.body.placement, ByParts):
        return _of_parts(options, setting, setting.body.placement)
    growth, names = scaling(setting.body, setting.schema), tuple(setting.schema.lengths_of_height)
    if options.sides == "free":
        bones, growth = names, growth._replace(groups=jnp.eye(len(names), dtype=growth.groups.dtype))
    else:
        bones = tuple(dict.fromkeys(name[2:] if name.startswith(("l_", "r_")) else name for name in names))
    every_sd = deviations(options.bone_sd, _usual_sd(), bones, "unknown 'lengths': bone_sd", "bone")
    means = deviations(options.bone_mean, {"*": 0.0}, bones, "unknown 'lengths': bone_mean", "bone")
    _check_means(dict(zip(bones, zip(means, every_sd, strict=True), strict=True)))
    # A length on which nothing depends has nothing to say.
    used = np.asarray(growth.groups).T @ (np.asarray(growth.values) != 0) > 0
    chosen = [place for place, sd in enumerate(every_sd) if used[place] and sd > 0]
    bones, bone_sd = tuple(bones[place] for place in chosen), [every_sd[place] for place in chosen]
    mean = [0.0 if {bones[k], f"l_{bones[k]}", f"r_{bones[k]}"} & setting.measured else means[place] for k, place in enumerate(chosen)]
    overall = options.overall_sd_with_height if setting.has_height else options.overall_sd
    sd = np.array(_with_session([overall, *bone_sd], bones, setting))
    mixing = np.eye(len(sd))
    if options.sides == "alike":
        mixing[1:, 1:] = sd[1:, None] * symmetric_root(_correlations(bones, setting)) / sd[1:]
    growth = growth._replace(groups=growth.groups[:, np.array(chosen, int)] @ jnp.asarray(mixing[1:, 1:], growth.groups.dtype))
    prior = unknown_about_zero(NAME, (OVERALL, *bones), ("",) * len(sd), sd.tolist(), options.lasts_s, setting, Body, change, growth)
    # The entries at which the bones have their expected deviations.
    centre = np.linalg.solve(mixing, [0.0, *mean])
    return replace(prior, mean=jnp.asarray(centre, prior.mean.dtype), mixing=jnp.asarray(mixing, prior.mean.dtype))


def _of_parts(options: Options, setting: Setting, placement: ByParts) -> Unknown:
    """Build the unknown of a body that is placed by parts.

    Raises:
        InputError: a key matches no part, or left and right parts are to be alike.
    """
    if options.sides == "alike" and "sides" in options.model_fields_set:
        problem, expected = '"alike", with a body that is placed by "parts"', '"free": each part has a length of its own'
        raise input_error("unknown 'lengths': sides", problem, expected, "take the line out")
    stems = part_stems(placement)
    bone_sd = deviations(options.bone_sd, _usual_sd(), stems, "unknown 'lengths': bone_sd", "part")
    means = deviations(options.bone_mean, {"*": 0.0}, stems, "unknown 'lengths': bone_mean", "part")
    overall = options.overall_sd_with_height if setting.has_height else options.overall_sd
    session_sd = [_sd_in_session(stem, setting) for stem in stems]
    sd = [max(values) if values else math.hypot(overall, usual) for values, usual in zip(session_sd, bone_sd, strict=True)]
    mean = [
        0.0 if {stem, name, f"l_{stem}", f"r_{stem}"} & setting.measured else value
        for stem, name, value in zip(stems, placement.names, means, strict=True)
    ]
    return centred(size_of_parts(NAME, sd, options.lasts_s, setting, stretched), mean)


def _usual_sd() -> dict[str, float]:
    return {f"*{name}": value for name, value in bone_variation().sd.items()} | {"*": OTHER_SD}


def _check_means(priors: Mapping[str, tuple[float, float]]) -> None:
    """Check that no bone has another mean, but no standard deviation."""
    for bone, (mean, sd) in priors.items():
        if mean and not sd:
            problem, remedy = (
                f"{mean:g}, and {bone} has the standard deviation 0",
                "raise bone_sd, or give the length in the session or the body file",
            )
            raise input_error(f"unknown 'lengths': bone_mean.{bone}", problem, "a bone that is not known", remedy)


def _correlations(bones: tuple[str, ...], setting: Setting) -> Float[np.ndarray, "bone bone"]:
    """Return the prior's correlations. A bone of which the session says how well it is known is known by itself."""
    from_session = np.array([bool(_sd_in_session(bone, setting)) for bone in bones], bool)
    correlations = bone_variation().correlations(bones)
    correlations[from_session] = correlations[:, from_session] = 0.0
    np.fill_diagonal(correlations, 1.0)
    return correlations


def _sd_in_session(bone: str, setting: Setting) -> list[float]:
    """Return the standard deviations that the session gives for a bone. Where both sides have one length, it may name one of them."""
    session_sd = setting.subject.lengths_sd
    return [session_sd[name] for name in (bone, f"l_{bone}", f"r_{bone}") if name in session_sd]


def _with_session(sd: list[float], bones: tuple[str, ...], setting: Setting) -> list[float]:
    """Return the standard deviations, overall and of each bone, that give the lengths those of the session, where it says them."""
    session_sd, names = setting.subject.lengths_sd, tuple(setting.schema.lengths_of_height)
    for key in session_sd:
        if key != OVERALL and key not in names:
            raise InputError(f"session.toml: subject.lengths_sd: '{key}': no such length of the body; {nearest(key, (OVERALL, *names))}")
    if not session_sd:
        return sd
    lengths = [_sd_in_session(bone, setting) for bone in bones]
    smallest = min((max(values) for values in lengths if values), default=math.inf)
    overall = min(session_sd.get(OVERALL, sd[0]), MOST_COMMON * smallest)
    return [overall, *(math.sqrt(max(values) ** 2 - overall**2) if values else usual for values, usual in zip(lengths, sd[1:], strict=True))]


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
