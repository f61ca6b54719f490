"""The first pose of a session: its angles as they are, or the pose of the least misfit to its markers and keypoints; and how thick the body looks."""

from collections.abc import Mapping
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.errors import input_error
from bayes_body.initial.fit import SETTLED, fit
from bayes_body.initial.lengths import factors
from bayes_body.initial.measurements import read_measurements, unused_names
from bayes_body.initial.misfit import Problem
from bayes_body.initial.outline import LEAST_OVERLAP, fit_outline
from bayes_body.initial.points import body_points
from bayes_body.initial.problem import build_problem
from bayes_body.initial.report import FirstPose, tell
from bayes_body.model.build import Model, load_model
from bayes_body.session.session import Session, Subject


def is_fitted(session: Session) -> bool:
    """Whether the session asks for a fit: of its first pose, or of how thick the body looks there."""
    return bool(session.initial_markers or session.initial_keypoints or session.fit_outline)


def with_first_pose(model: Model, session: Session) -> Model:
    """The model with the session's first pose for its initial state, and with fitted lengths and outline if the session asks for them.

    Raises:
        InputError: as `first_pose`.
    """
    return apply_first_pose(model, session, first_pose(model, session))


def apply_first_pose(model: Model, session: Session, found: FirstPose) -> Model:
    """The model with that pose for its initial state, and with the lengths and the outline that were fitted."""
    if found.lengths_m or found.outline_radii_m:
        subject = session.subject
        if not model.definition.takes_measures_of(subject.body):
            # As `load_model` has it: another body's measures mean nothing here, a height means the same for all.
            subject = Subject(height_m=subject.height_m)
        lengths, radii = found.lengths_m or subject.lengths_m, found.outline_radii_m or subject.outline_radii_m
        subject = replace(subject, body=model.definition.body_name, lengths_m=lengths, outline_radii_m=radii)
        model = load_model(model.definition, replace(session, subject=subject))
    return model.beginning_at(jnp.asarray(found.pose))


def first_pose(model: Model, session: Session) -> FirstPose:
    """The pose of frame 0 as the session has it: its angles as they are, or what fits its markers and keypoints best.

    Angles that are given beside markers or keypoints draw the fit to them.

    Raises:
        FaultyFileError: markers or keypoints hold values that cannot be used, a sentence each.
        InputError: too few points, or lengths to be fitted from one camera, or an outline without silhouettes, or the fit did not converge.
    """
    if session.fit_lengths:
        _check_lengths(session)
    found = _posed(model, session)
    return _with_outline(model, session, found) if session.fit_outline else found


def _posed(model: Model, session: Session) -> FirstPose:
    if not session.initial_markers and not session.initial_keypoints:
        return FirstPose(model.initial["pose"])
    points = body_points(model.body)
    measurements = read_measurements(session, points)
    problem = build_problem(model, session, points, measurements)
    best, gain = fit(problem, "xyz".index(session.up))
    told = tell(session, points, measurements, best.distances, best.pose, _lengths(model, session, problem, best.z))
    remarks = [*unused_names(session, points), *told.remarks]
    if gain > SETTLED:
        remarks.append("the first pose had not settled when the fit ended: look at it before you trust it")
    return told._replace(remarks=tuple(remarks))


def _with_outline(model: Model, session: Session, found: FirstPose) -> FirstPose:
    outline = fit_outline(apply_first_pose(model, session, found), session)
    if outline.radii_m:
        return found._replace(outline_radii_m=outline.radii_m)
    overlap = f"the body in its first pose overlaps with the silhouettes by {outline.before:.2f} (IoU; expected {LEAST_OVERLAP:g} at least)"
    return found._replace(remarks=(*found.remarks, f"{overlap}: how thick it looks was not fitted; look at the pose before you trust it"))


def _check_lengths(session: Session) -> None:
    cameras = [name for name, keypoints in session.initial_keypoints.items() if any(point[2] > 0 for point in keypoints.values())]
    if not session.initial_markers and len(cameras) < 2:
        found = f"true, with keypoints from {len(cameras)} camera{'s' * (len(cameras) != 1)} and no markers"
        expected = "markers, or keypoints from two cameras: one camera cannot tell a small person from a far one"
        raise input_error("session.toml: initial.fit_lengths", found, expected, "set it to false and give the subject's height_m, or give more")


def _lengths(model: Model, session: Session, problem: Problem, z: Float[Array, " group"]) -> Mapping[str, float]:
    if not session.fit_lengths:
        return {}
    fitted = np.asarray(problem.scaling.values * factors(problem.scaling, z), float)
    return dict(zip(model.definition.body.lengths_of_height, fitted.tolist(), strict=True))
