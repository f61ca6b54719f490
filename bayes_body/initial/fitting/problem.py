"""The optimisation problem of the first pose, from a session and a model: the measurements as arrays, and a prior."""

import jax
import numpy as np

from bayes_body.base.geometry.namespaces import device_array
from bayes_body.initial.fitting.fit import fit_resting_pose
from bayes_body.initial.fitting.measurements import Measurements
from bayes_body.initial.fitting.misfit import Prior, Problem
from bayes_body.initial.fitting.points import Points
from bayes_body.model.body.lengths import fixed, scaling
from bayes_body.model.body.solids import Body
from bayes_body.model.build import Model
from bayes_body.recording.session.session import Session

# Standard deviation of an angle (radians) or a position (metres) that a session gives together with markers or keypoints.
GIVEN_SD = {True: 0.35, False: 0.2}
# Standard deviations of the body's tilt, radians, and of a joint about its resting angle, as a fraction of its range; the values suit one camera.
TILT_SD = 0.4
RANGE_SHARE = 0.25
# With data of more than one camera, the prior should decide only what the data leave open: its standard deviations are multiplied by this.
LOOSER = 8.0


def build_problem(model: Model, session: Session, points: Points, measurements: Measurements) -> Problem:
    """Return the problem of a session's first pose, in the model's dtype. The prior's mean is the resting pose, or the session's value of a dof."""
    body, dtype = model.body.by_angles, model.body.lengths.dtype
    marker_weights, pixel_weights = (np.asarray(weights) * points.weight for weights in (measurements.marker_weights, measurements.pixel_weights))
    weighted = measurements._replace(marker_weights=marker_weights, pixel_weights=pixel_weights)
    problem = Problem(
        body=body,
        scaling=scaling(body, model.definition.body) if fits_lengths(model, session) else fixed(body),
        rig=model.rig,
        points=points,
        measurements=jax.tree.map(lambda leaf: device_array(leaf, dtype), weighted),
        tolerance=device_array(points.tolerance_m, dtype),
        prior=_prior(body, session, points),
    )
    has_value = np.array([name in session.initial for name in body.dof_names])
    mean = np.where(has_value, problem.prior.mean, fit_resting_pose(problem))
    return problem._replace(prior=problem.prior._replace(mean=device_array(mean, dtype)))


def fits_lengths(model: Model, session: Session) -> bool:
    """Return whether the body's lengths are fitted together with the pose.

    They are if the session says so, or if they are unknown to the model and two cameras or markers tell them. With the lengths of a table, a pose
    bends joints to make up for them.
    """
    cameras = sum(any(point[2] > 0 for point in keypoints.values()) for keypoints in session.initial_keypoints.values())
    told = bool(session.initial_markers) or cameras > 1
    return session.fit_lengths or (told and any(term.name == "lengths" for term in model.unknowns))


def _prior(body: Body, session: Session, points: Points) -> Prior:
    low, high = np.asarray(body.skeleton.low, float), np.asarray(body.skeleton.high, float)
    width = LOOSER if session.initial_markers or len(session.initial_keypoints) > 1 else 1.0
    mean, sd = np.clip(0.0, low, high), np.where(np.isfinite(high - low), width * RANGE_SHARE * (high - low), np.inf)
    topology = body.skeleton.topology
    root = topology.motions[0]
    # A body with a free root can face any direction, and is expected to stand upright. A body fixed to the world stands as its angles say.
    floats = any(motion.is_shift for motion in root)
    if floats:
        sd[[motion.dof for motion in root]] = np.inf
    for name, value in session.initial.items():
        k = body.dof_names.index(name)
        mean[k], sd[k] = value, GIVEN_SD[topology.angular[k]]
    up, upright = np.eye(3)["xyz".index(session.up)], floats / (width * TILT_SD) ** 2
    arrays = (device_array(array, body.lengths.dtype) for array in (mean, sd, up, upright, np.zeros(len(points.names))))
    return Prior(*arrays)
