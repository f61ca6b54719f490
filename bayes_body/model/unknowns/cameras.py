r"""The cameras as unknowns: each is turned a little about its own centre and then moved, in its own axes,

$$X_c' = e^{[\omega_c]_\times} (R_c X + t_c) + \tau_c, \qquad f_c' = f_c e^{\phi_c}, \qquad c_c' = c_c + \gamma_c.$$

A session may say how well each camera is known (`turn_sd_deg`, `move_sd_m`): this replaces the options below, for that camera.

The priors of all cameras, around their calibration, fix the world: rig and person may still move together by what these priors allow, and no image
shows it. A focal length is hardly told from a move along the optical axis, so it is known unless the definition says otherwise.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.base.geometry.camera import Camera
from bayes_body.base.registry import register
from bayes_body.base.shapes import Rotation, Vector3
from bayes_body.base.toml.schema import NonNegative, Positive
from bayes_body.density.factor import Numbered, Variables
from bayes_body.model.unknowns.unknown import Setting, Unknown, UnknownSchema, unknown_about_zero
from bayes_body.recording.session.session import CameraUncertainty

NAME = "cameras"
MOTION = ("turn_x", "turn_y", "turn_z", "move_x", "move_y", "move_z")


class Options(UnknownSchema):
    """Options of `[[unknown]] kind = "cameras"`: standard deviations about the calibration, for each camera and each axis."""

    turn_sd_deg: Positive = 0.5
    """[degrees] of a turn about the camera's centre."""
    move_sd_m: Positive = 0.02
    """[metres] of a move."""
    focal_sd: NonNegative = 0.0
    """relative, of the focal length; with 0 it is known."""
    centre_sd_px: NonNegative = 0.0
    """[pixels] of the principal point; with 0 it is known."""
    lasts_s: Positive = 3600.0
    """[s] after this time an error has faded to 37 %. A camera on a stand does not move."""


def change(rig: Camera, value: Float[Array, " entry"], values: Variables) -> Camera:
    """Return the cameras moved. Behind the six entries of a camera's motion there may be its focal length, and two of its principal point."""
    del values
    motion, intrinsics = jnp.split(value.reshape(rig.focal.shape[0], -1), [6], axis=1)
    rig = jax.vmap(moved)(rig, motion)
    if intrinsics.shape[1] in (1, 3):
        rig = replace(rig, focal=rig.focal * jnp.exp(intrinsics[:, :1]))
    return replace(rig, centre=rig.centre + intrinsics[:, -2:]) if intrinsics.shape[1] > 1 else rig


def moved(camera: Camera, motion: Float[Array, "6"]) -> Camera:
    """Return one camera turned about its centre, then moved along its own axes, radians and metres."""
    R = rotation_of(motion[:3])
    rotation = jnp.sum(R[:, :, None] * camera.rotation[None], axis=1)
    return replace(camera, rotation=rotation, translation=jnp.sum(R * camera.translation, axis=1) + motion[3:])


def rotation_of(turn: Vector3) -> Rotation:
    """Return the rotation matrix of a rotation vector of less than some degrees: its series, which is smooth at 0, with an error of the 4th order."""
    x, y, z = turn
    zero = jnp.zeros_like(x)
    cross = jnp.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]])
    square = jnp.sum(turn * turn)
    return jnp.eye(3, dtype=turn.dtype) + (1 - square / 6) * cross + (0.5 - square / 24) * jnp.sum(cross[:, :, None] * cross[None], axis=1)


@register("unknown", NAME, Options)
def build(options: Options, setting: Setting, **_: Any) -> Unknown:
    """Build the unknown for one rig."""
    uncertainties = setting.uncertainties or (CameraUncertainty(),) * len(setting.cameras)
    entries = [
        (f"{camera}_{name}", unit, sd)
        for camera, uncertainty in zip(setting.cameras, uncertainties, strict=True)
        for name, unit, sd in _entries(options, uncertainty)
    ]
    labels, units, sd = zip(*entries, strict=True)
    moves = Numbered("camera", tuple(np.repeat(np.arange(len(setting.cameras)), len(entries) // len(setting.cameras)).tolist()))
    return unknown_about_zero(NAME, labels, units, list(sd), options.lasts_s, setting, Camera, change, moves=moves)


def _entries(options: Options, uncertainty: CameraUncertainty) -> Iterator[tuple[str, str, float]]:
    """Yield name, unit and standard deviation of each entry of one camera: what the session says, else the options."""
    turn_sd, move_sd_m = uncertainty.turn_sd or (math.radians(options.turn_sd_deg),) * 3, uncertainty.move_sd_m or (options.move_sd_m,) * 3
    yield from zip(MOTION, ("rad",) * 3 + ("m",) * 3, (*turn_sd, *move_sd_m), strict=True)
    if options.focal_sd:
        yield "focal", "", uncertainty.focal_sd or options.focal_sd
    if options.centre_sd_px:
        yield from zip(("centre_u", "centre_v"), ("px", "px"), uncertainty.centre_sd_px or (options.centre_sd_px,) * 2, strict=True)
