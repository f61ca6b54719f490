"""The first pose of a session: given, fitted, searched or stored; and the model that starts from it."""

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.base.errors import input_error
from bayes_body.initial.fitting.fit import SETTLED, fit
from bayes_body.initial.fitting.measurements import read_measurements, unused_names
from bayes_body.initial.fitting.misfit import Problem
from bayes_body.initial.fitting.outline import LEAST_OVERLAP, fit_outline
from bayes_body.initial.fitting.points import body_points, factors
from bayes_body.initial.fitting.problem import build_problem
from bayes_body.initial.fitting.report import FirstPose, Source, tell
from bayes_body.initial.search.automatic import find_first_pose
from bayes_body.initial.stored import restored
from bayes_body.model.build import Model, build_model
from bayes_body.model.definition import Definition
from bayes_body.recording.readers.keypoints.series import read_series
from bayes_body.recording.session.session import Keypoints, Session, Subject

type Show = Callable[[str], None]


def load_model(name: str | Path | Definition, session: Session, show: Show = print) -> Model:
    """Return the model of that name (or path) for a session, starting from the session's first pose.

    Given angles are used unchanged. If the session gives markers, keypoints or silhouettes, the pose, the lengths or the outline are fitted to them
    once, here. This takes some seconds and is reported. If the session has no first pose but keypoints in every frame, the pose is fitted to the
    keypoints of frame 0. Without these, the person is searched for in the pictures of the first frames (`initial.automatic`).

    Args:
        name: name of a definition that ships, or the path of one, or the definition itself.
        session: the recording.
        show: receives a line for the user about each fit.

    Raises:
        InputError: the definition, the subject or the first pose cannot be used, or there is none and no person is found.
    """
    model = build_model(name, session)
    session = with_first_keypoints(model, session)
    return apply_first_pose(model, session, first_pose(model, session, show=show))


def first_pose_source(model: Model, session: Session, table: Mapping[str, Any] | None = None) -> Source:
    """Return where the first pose of a session comes from.

    Args:
        model: the model whose body is placed.
        session: the recording, with its keypoints of frame 0 (`with_first_keypoints`).
        table: the first pose of a run that is continued (`stored`); None if there is none.
    """
    if table is not None:
        return "stored"
    if not _is_posed(model, session):
        return "searched"
    return "fitted" if session.initial_markers or session.initial_keypoints or session.fit_outline else "given"


def first_pose(
    model: Model,
    session: Session,
    source: Source | None = None,
    *,
    show: Show | None = None,
    seed: int = 0,
    table: Mapping[str, Any] | None = None,
    table_name: str = "the first pose",
) -> FirstPose:
    """Return the pose of frame 0: given, fitted, searched or stored.

    Angles that are given together with markers or keypoints are the centre of the fit's prior.

    Args:
        model: the model whose body is placed.
        session: the recording, with its keypoints of frame 0 (`with_first_keypoints`).
        source: where the pose comes from; by default what `first_pose_source` returns. With "fitted", the person is never searched for, and angles
            without markers and keypoints are taken as they are.
        show: receives a line with the duration and the residuals of a fit or a search, and a line for each remark.
        seed: seed of the search.
        table: a stored first pose.
        table_name: its name in error messages.

    Raises:
        FaultyFileError: markers or keypoints hold values that cannot be used; one sentence for each.
        InputError: there are too few points, lengths are to be fitted from one camera, an outline is to be fitted without silhouettes, the fit did
            not converge, no person was found, or the stored pose cannot be used.
    """
    source = source or first_pose_source(model, session, table)
    if source == "given":
        return FirstPose(model.first_pose, source)
    if source == "stored":
        return restored(model, table or {}, table_name)
    show = show or _show_nothing
    begun = time.perf_counter()
    estimate = find_first_pose(model, session, show, seed) if source == "searched" else _fitted(model, session)
    if session.fit_outline:
        estimate = _with_outline(model, session, estimate)
    _show_fit(estimate, time.perf_counter() - begun, show)
    return estimate


def _show_nothing(line: str) -> None:
    pass


def _show_fit(estimate: FirstPose, seconds: float, show: Show) -> None:
    misfits = [f"{1000 * estimate.median_m:.0f} mm off the markers"] if np.isfinite(estimate.median_m) else []
    misfits += [f"{estimate.median_px:.0f} px off the keypoints"] if np.isfinite(estimate.median_px) else []
    misfit = f", {' and '.join(misfits)} (median)" if misfits else ""
    show(f"first pose: fitted in {seconds:.0f} s{misfit}")
    for remark in estimate.remarks:
        show(f"first pose: {remark}")


def unposed(session: Session) -> Session:
    """Return the session without a first pose, and without the markers and keypoints of the first frame."""
    return replace(session, initial={}, initial_markers={}, initial_keypoints={})


def _is_posed(model: Model, session: Session) -> bool:
    """Return whether the session says where the body is in frame 0. A body on a fixed base needs no first pose."""
    return _is_placed(model, session) or bool(session.initial_markers or session.initial_keypoints)


def _is_placed(model: Model, session: Session) -> bool:
    """Return whether the session gives a dof without limits, such as the root's position, or the body has no such dof."""
    low, high = np.asarray(model.body.skeleton.low), np.asarray(model.body.skeleton.high)
    endless = [name for name, bounded in zip(model.body.dof_names, np.isfinite(low) & np.isfinite(high), strict=True) if not bounded]
    return not endless or any(name in session.initial for name in endless)


def with_first_keypoints(model: Model, session: Session) -> Session:
    """Return the session; if it has no first pose, add the keypoints that its cameras have in frame 0.

    Raises:
        InputError: a file of keypoints cannot be read.
    """
    if _is_posed(model, session):
        return session
    keypoints: dict[str, Keypoints] = {}
    for view in session.views:
        path = session.keypoints_path(view)
        points = {} if path is None else read_series(path).frame(session.number(view, 0))
        if points:
            keypoints[view.camera.name] = points
    return replace(session, initial_keypoints=keypoints)


def apply_first_pose(model: Model, session: Session, estimate: FirstPose) -> Model:
    """Return the model that starts from that pose, with the fitted lengths and outline."""
    if estimate.lengths_m or estimate.outline_radii_m:
        subject = session.subject
        if not model.definition.takes_measures_of(subject.body):
            # As in `build_model`: the measures of another body do not apply here, but a height has the same meaning for every body.
            subject = Subject(height_m=subject.height_m)
        lengths, radii = estimate.lengths_m or subject.lengths_m, estimate.outline_radii_m or subject.outline_radii_m
        subject = replace(subject, body=model.definition.body_name, lengths_m=lengths, outline_radii_m=radii)
        model = build_model(model.definition, replace(session, subject=subject))
    return model.beginning_at(jnp.asarray(estimate.pose), estimate.draws)


def _fitted(model: Model, session: Session) -> FirstPose:
    if session.fit_lengths:
        _check_lengths(session)
    if not session.initial_markers and not session.initial_keypoints:
        return FirstPose(model.first_pose, "fitted")
    points = body_points(model.body.by_angles)
    measurements = read_measurements(session, points)
    problem = build_problem(model, session, points, measurements)
    best, gain = fit(problem, "xyz".index(session.up))
    estimate = tell(session, points, measurements, best.distances, best.pose, _lengths(model, session, problem, best.z))
    remarks = [*unused_names(session, points), *estimate.remarks]
    if gain > SETTLED:
        remarks.append("the fit did not converge within its steps: check the first pose before you trust it")
    return estimate._replace(remarks=tuple(remarks))


def _with_outline(model: Model, session: Session, estimate: FirstPose) -> FirstPose:
    outline = fit_outline(apply_first_pose(model, session, estimate), session)
    if outline.radii_m:
        return estimate._replace(outline_radii_m=outline.radii_m)
    overlap = f"the body in its first pose overlaps the silhouettes with an IoU of {outline.before:.2f} (expected at least {LEAST_OVERLAP:g})"
    return estimate._replace(remarks=(*estimate.remarks, f"{overlap}: the outline was not fitted; check the pose before you trust it"))


def _check_lengths(session: Session) -> None:
    cameras = [name for name, keypoints in session.initial_keypoints.items() if any(point[2] > 0 for point in keypoints.values())]
    if not session.initial_markers and len(cameras) < 2:
        problem = f"true, with keypoints from {len(cameras)} camera{'s' * (len(cameras) != 1)} and no markers"
        expected = "markers, or keypoints from two cameras: one camera cannot distinguish a small person from a distant one"
        remedy = "set it to false and give the subject's height_m, or give markers or more keypoints"
        raise input_error("session.toml: initial.fit_lengths", problem, expected, remedy)


def _lengths(model: Model, session: Session, problem: Problem, z: Float[Array, " group"]) -> Mapping[str, float]:
    if not session.fit_lengths:
        return {}
    fitted = np.asarray(problem.scaling.values * factors(problem.scaling, z), float)
    return dict(zip(model.definition.body.lengths_of_height, fitted.tolist(), strict=True))
