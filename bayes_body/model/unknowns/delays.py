r"""The cameras' delays as an unknown: a camera that is late by $d_c$ sees the pose $s_t + d_c v_t$, with the velocity v of the motion prior.

A delay counts against the first camera, whose clock is the recording's. It is of the first order in time: at an acceleration a, the error is
$a d_c^2 / 2$, 6 mm for a wrist at 20 ms. Shift a camera by whole frames first. A session may give each camera's delay
(`delay_s`) and its standard deviation.
"""

from dataclasses import replace
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from bayes_body.base.registry import register
from bayes_body.base.toml.schema import Positive
from bayes_body.density.factor import Numbered, Variable, Variables
from bayes_body.model.likelihood.markers_gaussian import MarkersGaussian
from bayes_body.model.unknowns.unknown import Setting, Unknown, UnknownSchema, centred, unknown_about_zero
from bayes_body.recording.session.session import CameraUncertainty

NAME, VELOCITY = "delays", "velocity"


class Options(UnknownSchema):
    """Options of `[[unknown]] kind = "delays"`, which needs `[dynamics] kind = "constant_velocity"`."""

    sd_s: Positive = 0.02
    """[s] standard deviation of a camera's delay against the first camera."""
    lasts_s: Positive = 3600.0
    """[s] after this time an error has faded to 37 %."""


def change(markers: MarkersGaussian, value: Float[Array, " entry"], values: Variables) -> MarkersGaussian:
    """Return the markers as each camera sees them at its own time."""
    delays = jnp.concatenate([jnp.zeros_like(value[:1]), value])
    return replace(markers, camera_steps=delays[:, None] * values[Variable(VELOCITY)])


@register("unknown", NAME, Options)
def build(options: Options, setting: Setting, **_: Any) -> Unknown:
    """Build the unknown for one rig."""
    labels, uncertainty = setting.cameras[1:], setting.uncertainties[1:] or (CameraUncertainty(),) * len(setting.cameras[1:])
    sd = [camera.delay_sd_s or options.sd_s for camera in uncertainty]
    attributes = {"sides": ("likelihood",), "reads": (VELOCITY,), "moves": Numbered("camera", tuple(range(1, len(setting.cameras))))}
    delays = unknown_about_zero(NAME, labels, ("s",) * len(labels), sd, options.lasts_s, setting, MarkersGaussian, change, **attributes)
    return centred(delays, [camera.delay_s for camera in uncertainty])
