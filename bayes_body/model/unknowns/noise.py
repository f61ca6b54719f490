r"""The noise of the keypoints as an unknown: the standard deviation of each camera's detections is $\sigma_c e^{x_c}$."""

from dataclasses import replace
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from bayes_body.base.registry import register
from bayes_body.base.toml.schema import Positive
from bayes_body.density.factor import Numbered, Variables
from bayes_body.model.likelihood.markers_gaussian import MarkersGaussian
from bayes_body.model.unknowns.unknown import Setting, Unknown, UnknownSchema, unknown_about_zero

NAME = "noise"


class Options(UnknownSchema):
    """Options of `[[unknown]] kind = "noise"`, for `markers_gaussian`."""

    sd: Positive = 0.3
    """relative standard deviation of a camera's `sd_px`."""
    lasts_s: Positive = 60.0
    """[s] after this time an error has faded to 37 %."""


def prepared(markers: MarkersGaussian) -> MarkersGaussian:
    """Return the markers with a scale of the noise in each camera."""
    return replace(markers, log_scale=jnp.zeros_like(markers.detections.sd_px))


def change(markers: MarkersGaussian, value: Float[Array, " entry"], values: Variables) -> MarkersGaussian:
    """Return the markers with other noise."""
    del values
    return replace(markers, log_scale=value)


@register("unknown", NAME, Options)
def build(options: Options, setting: Setting, **_: Any) -> Unknown:
    """Build the unknown for one rig."""
    labels = setting.cameras
    attributes = {"sides": ("likelihood",), "prepare": prepared, "moves": Numbered("camera", tuple(range(len(labels))))}
    return unknown_about_zero(
        NAME, labels, ("",) * len(labels), [options.sd] * len(labels), options.lasts_s, setting, MarkersGaussian, change, **attributes
    )
