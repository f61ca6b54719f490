"""Pixels of points on the parts' patches: the inner loop of every likelihood that evaluates fixed points of a body.

An evaluation projects two thousand points, so the derivative is written by hand: a gradient costs a third less than with automatic reverse mode
(docs/decisions). Reverse mode only; `camera.project` is the same map with all derivatives.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.base.geometry import camera as cameras
from bayes_body.base.geometry.camera import Camera, Pixels
from bayes_body.base.geometry.transforms import Transform
from bayes_body.base.shapes import Configuration, Pose
from bayes_body.model.body.solids import Body, Patches, Samples, Shapes, part_transforms, shape_patches, widened

type CameraPatches = Float[Array, "4 part 3"]


def rig_pixels(body: Body, rig: Camera, samples: Samples, configuration: Configuration) -> Pixels[Float[Array, "camera part sample"]]:
    """The pixels of each sample of each part of a posed body, in each camera of a rig."""
    return sample_pixels(rig, rig_patches(body, rig, configuration), samples)


def rig_patches(body: Body, rig: Camera, configuration: Configuration) -> Float[Array, "camera 4 part 3"]:
    """The parts' patches in each camera's frame: start, along, across and taper."""
    T_world_part = Transform(*jax.lax.optimization_barrier(tuple(part_transforms(body, configuration))))
    return solid_patches(widened(body, configuration).shapes, rig, T_world_part)


def solid_patches(shapes: Shapes, rig: Camera, T_world_part: Transform) -> Float[Array, "camera 4 part 3"]:
    """The same of solids that are placed one by one."""
    in_camera = jax.vmap(lambda camera: _camera_patches(shapes, T_world_part, camera))(rig)
    # The barrier keeps XLA from recomputing the patches for every sample.
    return jax.lax.optimization_barrier(in_camera)


def sample_pixels(rig: Camera, in_camera: Float[Array, "camera 4 part 3"], samples: Samples) -> Pixels[Float[Array, "camera part sample"]]:
    """The pixels of patch samples in each camera."""
    return jax.vmap(_pixels, in_axes=(0, 0, None))(rig, in_camera, samples)


def sample_slopes(body: Body, rig: Camera, samples: Samples, pose: Pose) -> tuple[Float[Array, "dof camera part sample"], Array]:
    """The derivatives of the samples' columns and rows by each dof, pixels per radian or metre."""

    def places(pose: Pose) -> tuple[Array, Array]:
        def pixels_of(camera: Camera, in_camera: CameraPatches) -> Pixels[Array]:
            t, s = samples
            X, Y, Z = (p.start + t * p.axis + s * p.half_width + t * s * p.taper for p in by_component(in_camera))
            # The hand-written derivative supports reverse mode only.
            return cameras.project_components(camera, X, Y, Z)

        pixels = jax.vmap(pixels_of)(rig, rig_patches(body, rig, pose))
        return pixels.u, pixels.v

    slopes = jax.jacfwd(places)(pose)
    return jnp.moveaxis(slopes[0], -1, 0), jnp.moveaxis(slopes[1], -1, 0)


def corner_pixels(
    rig: Camera, in_camera: Float[Array, "camera 4 part 3"], t: Float[np.ndarray, "corner part"], s: Float[np.ndarray, "corner part"]
) -> Pixels[Float[Array, "camera corner part"]]:
    """The same for a few points per part: parts are last, since a loop over four numbers does not fill a processor's registers."""

    def pixels_of(camera: Camera, in_camera: CameraPatches) -> Pixels[Float[Array, "corner part"]]:
        patch = Patches(*in_camera)
        X, Y, Z = (patch.start[:, k] + t * patch.axis[:, k] + s * patch.half_width[:, k] + t * s * patch.taper[:, k] for k in range(3))
        return _visible_pixels(camera, X, Y, Z)

    return jax.vmap(pixels_of)(rig, in_camera)


def by_component(in_camera: CameraPatches) -> list[Patches]:
    """The patches' X, Y and Z in the camera's frame, metres. Each vector has the shape (part, 1), for points of shape (part, sample)."""
    return [Patches(*component) for component in jnp.moveaxis(in_camera, -1, 0)[..., None]]


def _camera_patches(shapes: Shapes, T_world_part: Transform, camera: Camera) -> CameraPatches:
    world = shape_patches(shapes, T_world_part, camera.viewpoint)
    start, *directions = cameras.to_camera(camera, jnp.stack(world))
    return jnp.stack([start + camera.translation, *directions])


def _pixels(camera: Camera, in_camera: CameraPatches, samples: Samples) -> Pixels[Float[Array, "part sample"]]:
    return _visible_pixels(camera, *_spread(in_camera, samples))


def _visible_pixels(camera: Camera, X: Array, Y: Array, Z: Array) -> Pixels[Array]:
    # Visibility has no derivative and stays outside; XLA merges the common part of both.
    return Pixels(*_project(camera, X, Y, Z), cameras.in_view(camera, X, Y, Z))


type Components = tuple[Float[Array, "part sample"], Float[Array, "part sample"], Float[Array, "part sample"]]


@jax.custom_vjp
def _spread(in_camera: CameraPatches, samples: Samples) -> Components:
    """V0 + t V1 + s V2 + t s V3, by components in the camera's frame."""
    t, s = samples
    X, Y, Z = (p.start + p.axis * t + p.half_width * s + p.taper * (t * s) for p in by_component(in_camera))
    return X, Y, Z


def _spread_forward(in_camera: CameraPatches, samples: Samples) -> tuple[Components, Samples]:
    return _spread(in_camera, samples), samples


def _spread_backward(samples: Samples, cotangents: Components) -> tuple[Array, Samples]:
    t, s = samples
    # A matrix product: twelve separate sums would each recompute the cotangents.
    basis = jnp.stack([jnp.ones_like(t), t, s, t * s])
    back = [jnp.einsum("kpn,pn->kp", basis, component) for component in jax.lax.optimization_barrier(cotangents)]
    return jnp.stack(back, axis=-1), jax.tree.map(jnp.zeros_like, samples)


_spread.defvjp(_spread_forward, _spread_backward)


@jax.custom_vjp
def _project(camera: Camera, X: Array, Y: Array, Z: Array) -> tuple[Array, Array]:
    pixels = cameras.project_components(camera, X, Y, Z)
    return pixels.u, pixels.v


def _project_forward(camera: Camera, X: Array, Y: Array, Z: Array) -> tuple[tuple[Array, Array], tuple[Camera, Array, Array, Array]]:
    return _project(camera, X, Y, Z), (camera, X, Y, Z)


def _project_backward(saved: tuple[Camera, Array, Array, Array], cotangents: tuple[Array, Array]) -> tuple[Camera, Array, Array, Array]:
    camera, X, Y, Z = saved
    in_front = cameras.NEAR < Z
    inverse = jnp.where(in_front, 1 / jnp.where(in_front, Z, 1.0), 0.0)
    x, y = X * inverse, Y * inverse
    k1, k2, p1, p2, k3 = camera.distortion
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))
    # The Jacobian of the distortion is symmetric, so there is one mixed entry.
    mixed = x * y * slope + 2 * (p1 * x + p2 * y)
    # The barrier keeps XLA from repeating the map look-up for each of the three components.
    along_u, along_v = jax.lax.optimization_barrier(cotangents)
    a = camera.focal[0] * along_u
    b = camera.focal[1] * along_v + camera.skew * a
    back_X = (a * (radial + x * x * slope + 2 * p1 * y + 6 * p2 * x) + b * mixed) * inverse
    back_Y = (a * mixed + b * (radial + y * y * slope + 2 * p2 * x + 6 * p1 * y)) * inverse
    # A rig is calibrated, not inferred, so its cotangent is never used.
    return jax.tree.map(jnp.zeros_like, camera), back_X, back_Y, -(back_X * x + back_Y * y)


_project.defvjp(_project_forward, _project_backward)
