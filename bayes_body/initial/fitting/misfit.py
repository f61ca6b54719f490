r"""The misfit of a posed body to the measured points of the first pose: robust distances and a weak prior.

$$U = \sum_i w_i \Bigl[\tfrac{\nu + d_i}{2} \log\bigl(1 + \tfrac{r_i^2}{\nu \sigma_i^2}\bigr) + d_i \log \sigma_i\Bigr]
    + \tfrac12 \sum_k \bigl(\tfrac{s_k - m_k}{\tau_k}\bigr)^2 + \tfrac{1 - \cos\theta}{\tau_\theta^2} + \tfrac12 \|z\|^2,$$

$\theta$ is the body's tilt relative to the world's up direction. The residuals r have d dimensions: metres for markers (d = 3), pixels for keypoints
(d = 2). They follow a Student t distribution with $\nu = 3$. $\sigma$ combines the detector's error with the distance between the detector's point
and the body's point, projected to pixels at the point's depth. Source: Lange et al. 1989, Robust statistical modeling using the t distribution.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bayes_body.base.geometry import transforms
from bayes_body.base.geometry.camera import NEAR, Camera, project, to_camera
from bayes_body.base.shapes import Pose, Scalar, Vector3
from bayes_body.initial.fitting.measurements import Measurements
from bayes_body.initial.fitting.points import Points, as_markers, scaled
from bayes_body.initial.fitting.shares import pose_of
from bayes_body.model.body.kinematics import forward_kinematics, marker_positions
from bayes_body.model.body.lengths import Scaling
from bayes_body.model.body.solids import Body

NU = 3.0
DETECTOR_PX = 10.0
# The residual of a point that a camera cannot see, pixels: large but finite.
UNSEEN_PX = 3000.0


class Prior(NamedTuple):
    """Independent normal distributions of the dofs, radians and metres, and a preference for an upright body.

    Attributes:
        mean: mean of each dof.
        sd: standard deviation of each dof; infinite where nothing is known.
        up: the world's direction that points up.
        upright: strength with which the root's z is pulled towards `up`, 1 / sd^2 of its angle; 0 for a body that is fixed to the world.
        weights: strength of the downward pull on each of the body's points, per metre.
    """

    mean: Pose
    sd: Pose
    up: Vector3
    upright: Scalar
    weights: Float[Array, " point"]


class Problem(NamedTuple):
    """Everything that the misfit of a pose depends on.

    Attributes:
        body: the model's body.
        scaling: how its lengths can change.
        rig: the cameras.
        points: the points of the body that can be measured.
        measurements: the measured positions; their weights include those of the points.
        tolerance: expected distance of a measured point from the body's point, metres.
        prior: prior of the dofs.
    """

    body: Body
    scaling: Scaling
    rig: Camera
    points: Points
    measurements: Measurements
    tolerance: Float[Array, " point"]
    prior: Prior


type Parameters = Float[Array, " parameter"]
type Places = Float[Array, "point 3"]


def split(problem: Problem, parameters: Parameters) -> tuple[Pose, Float[Array, " group"]]:
    """Return the pose, within its limits, and the parameters of the lengths from a vector of unconstrained parameters."""
    count = len(problem.body.dof_names)
    return pose_of(problem.body.skeleton, parameters[:count]), parameters[count:]


class Distances(NamedTuple):
    """Distances between the measurements and the body's points, and their standard deviations."""

    metres: Float[Array, " point"]
    metres_sd: Float[Array, " point"]
    pixels: Float[Array, "camera point"]
    pixels_sd: Float[Array, "camera point"]


def distances(problem: Problem, places: Places) -> Distances:
    """Return the distances of all points, including points that were not measured."""

    def in_image(camera: Camera, pixels: Float[Array, "point 2"]) -> tuple[Float[Array, " point"], Float[Array, " point"]]:
        projection, visible = project(camera, places)
        depth = jnp.maximum(to_camera(camera, places)[:, 2] + camera.translation[2], NEAR)
        # Without a gradient, since a pose must not fit better just because it is farther away.
        sd = jnp.hypot(DETECTOR_PX, jax.lax.stop_gradient(camera.focal[0] * problem.tolerance / depth))
        return jnp.where(visible, _norm(projection - pixels), UNSEEN_PX), sd

    pixels, pixels_sd = jax.vmap(in_image)(problem.rig, problem.measurements.pixels)
    return Distances(_norm(places - problem.measurements.markers), problem.tolerance, pixels, pixels_sd)


def potential(problem: Problem, places: Places, missed: Distances, pose: Pose, z: Float[Array, " group"], width: Scalar | float) -> Scalar:
    """Return U of a pose whose points are at `places`, with distances `missed` from the measurements.

    Every standard deviation is multiplied by `width`. A large width gives a useful gradient to a fit that starts far from the solution.
    """
    measurements = problem.measurements
    markers = _robust(missed.metres, width * missed.metres_sd, measurements.marker_weights, 3)
    keypoints = _robust(missed.pixels, width * missed.pixels_sd, measurements.pixel_weights, 2)
    return markers + keypoints + _surprise(problem, places, pose) + 0.5 * jnp.sum(z * z)


def _surprise(problem: Problem, places: Places, pose: Pose) -> Scalar:
    prior = problem.prior
    fall = jnp.sum(prior.weights * (places @ prior.up))
    tilt = 1 - transforms.dot(forward_kinematics(problem.body.skeleton, pose).z[0], prior.up)
    return 0.5 * jnp.sum(((pose - prior.mean) / prior.sd) ** 2) + prior.upright * tilt + fall


class Explained(NamedTuple):
    """A posed body compared with the measurements: its misfit, pose, length parameters, points, and their distances to the measurements."""

    misfit: Scalar
    pose: Pose
    z: Float[Array, " group"]
    places: Places
    distances: Distances


def explain(problem: Problem, parameters: Parameters, width: Scalar | float) -> tuple[Scalar, Explained]:
    """Return U of unconstrained parameters (see `potential`), and the posed body it belongs to."""
    pose, z = split(problem, parameters)
    places = places_of(problem, pose, z)
    missed = distances(problem, places)
    value = potential(problem, places, missed, pose, z, width)
    return value, Explained(value, pose, z, places, missed)


def places_of(problem: Problem, pose: Pose, z: Float[Array, " group"]) -> Places:
    """Return the positions of the posed body's points, metres."""
    body = scaled(problem.body, problem.scaling, z)
    return marker_positions(body.skeleton, as_markers(body, problem.points), pose)


def _robust(distance: Array, sd: Array, weight: Array, dimensions: int) -> Scalar:
    return jnp.sum(weight * (0.5 * (NU + dimensions) * jnp.log1p((distance / sd) ** 2 / NU) + dimensions * jnp.log(sd)))


def _norm(v: Float[Array, "*batch axis"]) -> Float[Array, "*batch"]:
    # sqrt's slope at 0 is infinite.
    return jnp.sqrt(jnp.maximum(jnp.sum(v * v, axis=-1), 1e-12))
