"""The optimisation problem of a body and landmarks: that of a first pose (`bayes_body.initial`), with markers only and without cameras."""

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.base.errors import input_error
from bayes_body.base.geometry.camera import Camera
from bayes_body.initial.fitting.fit import fit_resting_pose
from bayes_body.initial.fitting.measurements import Measurements
from bayes_body.initial.fitting.misfit import Prior, Problem
from bayes_body.initial.fitting.points import Points
from bayes_body.model.body.lengths import fixed, scaling
from bayes_body.model.body.schema import BodySchema
from bayes_body.model.body.solids import Body

# The prior is weak: it decides only what the landmarks leave open. Standard deviations of a joint, as a fraction of its range, and of the body's
# tilt, radians.
RANGE_SHARE = 2.0
TILT_SD = 3.0
UP = (0.0, 0.0, 1.0)


def build_problem(body: Body, schema: BodySchema | None) -> Problem:
    """Return the problem without landmarks. Lengths are fitted if a schema is given; the prior pulls the angles towards the resting pose."""
    names, dtype = body.markers.names, body.lengths.dtype
    points = Points(names, body.markers.joints, 0, jnp.zeros((0, 3), dtype))
    problem = Problem(
        body=body,
        scaling=fixed(body) if schema is None else scaling(body, schema),
        rig=_no_camera(dtype),
        points=points,
        measurements=landmarks_of_frame(np.full((len(names), 3), np.nan), dtype),
        tolerance=jnp.asarray(points.tolerance_m, dtype),
        prior=_prior(body, dtype),
    )
    return problem._replace(prior=problem.prior._replace(mean=fit_resting_pose(problem)))


def landmarks_of_frame(places: Float[np.ndarray, "point 3"], dtype: jnp.dtype) -> Measurements:
    """Return the positions of the body's points in one frame (metres, NaN where unknown) as measurements."""
    is_measured = np.isfinite(places).all(axis=-1)
    no_weights = jnp.zeros((0, len(places)), dtype)
    no_pixels = no_weights[..., None] * jnp.zeros(2, dtype)
    markers = jnp.asarray(np.where(is_measured[:, None], places, 0.0), dtype)
    return Measurements(markers, jnp.asarray(is_measured, dtype), no_pixels, no_pixels, no_weights)


def places_of(body: Body, landmarks: Mapping[str, np.ndarray]) -> Float[np.ndarray, "frame marker 3"]:
    """Return the landmarks in the order of the body's markers; NaN for a marker without a landmark.

    Raises:
        InputError: a landmark does not have the same number of frames as the first one.
    """
    frames = len(next(iter(landmarks.values()), ()))
    for name, landmark in landmarks.items():
        if landmark.shape != (frames, 3):
            problem = f"{len(landmark)} frames" if landmark.shape[1:] == (3,) else f"an array of shape {landmark.shape}"
            raise input_error(f"landmarks: {name}", problem, f"({frames}, 3), like the first", "give each in every frame, NaN where unknown")
    places = np.full((frames, len(body.markers.names), 3), np.nan)
    for m, name in enumerate(body.markers.names):
        if name in landmarks:
            places[:, m] = landmarks[name]
    # A point with an unknown coordinate counts as unknown.
    places[~np.isfinite(places).all(axis=-1)] = np.nan
    return places


def _prior(body: Body, dtype: jnp.dtype) -> Prior:
    low, high = np.asarray(body.skeleton.low, float), np.asarray(body.skeleton.high, float)
    sd = np.where(np.isfinite(high - low), RANGE_SHARE * (high - low), np.inf)
    root = body.skeleton.topology.motions[0]
    floats = any(motion.is_shift for motion in root)
    if floats:
        sd[[motion.dof for motion in root]] = np.inf
    weights = np.zeros(len(body.markers.names))
    return Prior(*(jnp.asarray(array, dtype) for array in (np.clip(0.0, low, high), sd, UP, floats / TILT_SD**2, weights)))


def _no_camera(dtype: jnp.dtype) -> Camera:
    def empty_array(*shape: int) -> Array:
        return jnp.zeros((0, *shape), dtype)

    return Camera(empty_array(3, 3), empty_array(3), empty_array(2), empty_array(2), empty_array(), empty_array(5), empty_array(), empty_array(2))
