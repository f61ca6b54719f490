"""The first pose from the pictures alone, for a model of any body: detectors, and a search for a loose-limbed body (initial/search/person_search.py).

The search samples a loose-limbed body, whatever the model is. Some of its draws are chosen by weight, and a pose of the model's body is fitted to the
markers of each. A likelihood of the whole body then refines these poses (initial/search/refine.py). They are equally likely first poses, so the
sampler that starts from them knows how uncertain the first frame is, and which way the person may face.

The detectors also tell whether the first frame shows a person, and if not, which later frame does.
"""

import re
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NoReturn

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from bayes_body.base.errors import InputError, input_error
from bayes_body.initial.detection.detect import TRUSTED, Detected, detect
from bayes_body.initial.fitting.fit import fit, fit_draws, unbounded
from bayes_body.initial.fitting.measurements import FEWEST, PREFIX, read_measurements
from bayes_body.initial.fitting.points import Points, body_points
from bayes_body.initial.fitting.problem import build_problem
from bayes_body.initial.fitting.report import FirstPose, tell
from bayes_body.initial.search.person_search import Found, PersonSearch
from bayes_body.initial.search.refine import refine, resampled
from bayes_body.initial.stored import DIGITS
from bayes_body.kernels.batching import everywhere
from bayes_body.model.body.placement import POSE
from bayes_body.model.build import Model, with_likelihoods
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.observation.frames import read_frame
from bayes_body.recording.observation.silhouettes import has_silhouettes
from bayes_body.recording.session.session import Session

# The part that says where a person is.
TRUNK = "torso"
# If the first frame shows nobody: the number of later frames that are looked at, and the seconds between them.
LOOKED_AT, LOOK_S = 20, 1.0


def shows_somebody(session: Session, frame: int) -> bool:
    """Return whether detectors find a person in a frame, counted from 0.

    Raises:
        InputError: a file of the session cannot be used.
    """
    return TRUNK in detect(session, frame, TRUSTED).parts


def later_frame(session: Session) -> int | None:
    """Return the first frame after frame 0 that shows a person, counted from 0; None if no frame that is looked at does.

    Raises:
        InputError: a file of the session cannot be used.
    """
    step = max(1, round(LOOK_S * session.fps))
    looked_at = range(step, min(session.frames, step * LOOKED_AT + 1), step)
    return next((frame for frame in looked_at if shows_somebody(session, frame)), None)


def nobody_first(session: Session) -> str | None:
    """Return a sentence if the silhouettes show nobody in frame 0; None if they show somebody, are missing, or the session has other pose data."""
    pose_data = session.initial or session.initial_markers or session.initial_keypoints or any(view.keypoints for view in session.views)
    if pose_data or not has_silhouettes(session):
        return None
    first = session.first_frame
    try:
        if shows_somebody(session, 0):
            return None
        later_index = later_frame(session)
    except InputError as error:
        return f"It is not known whether somebody is in frame {first}: {error}"
    if later_index is None:
        remedy = "check the silhouettes and the calibration (turned pictures, other axes), or give keypoints"
        return f"Nobody is detected in frame {first}, nor in {LOOKED_AT} s after it: {remedy}."
    remedy = f"import again with --first-frame {session.frame_number(later_index)} --overwrite, or give the same option to `bayes-body track`"
    return f"Nobody is detected in frame {first}, the first one; somebody is in frame {session.frame_number(later_index)}: {remedy}."


# The definitions whose likelihoods refine found poses: that of the first rounds, and the one that is added to it in the later rounds. Both compare
# the body with the silhouette, and the silhouette with the body.
JUDGES = "silhouettes", "silhouette_pixels"
# Number of poses that are drawn.
DRAWS = 32
# Limits for warnings: the shares of the weight that faces the other way or is elsewhere, and the number of effective draws.
MOST_TURNED, MOST_ELSEWHERE, FEWEST_DRAWS = 0.05, 0.3, 5.0
# Markers of a leg below the hip.
LEG = re.compile(r"[lr]_(knee|ankle|heel|toe|big_toe|small_toe)")
# Below this share of the weight, poses that face the other way are not used: a sampler may not be able to reject them by its first frame alone.
LEAST_TURNED = 0.25


def find_first_pose(model: Model, session: Session, show: Callable[[str], None], seed: int = 0) -> FirstPose:
    """Return the pose of frame 0 that is found in the pictures, and DRAWS equally likely ones; lines for the user go to `show`.

    Args:
        model: the model whose body is placed.
        session: the recording, without a first pose.
        show: receives a line for the user about each step.
        seed: seed of the draws.

    Raises:
        InputError: there are no silhouettes, no person was detected in frame 0, or the body has too few markers.
    """
    _check_silhouettes(model, session)
    show("first pose: looking for the person in the first frames")
    begun = time.perf_counter()
    person = PersonSearch(session, seed=seed).window(0)
    for notice in person.notices:
        show(f"first pose: {notice}")
    if isinstance(person, Detected):
        _nobody(person, model, session)
    show(f"first pose: a person was found in {time.perf_counter() - begun:.0f} s; {person.precision}, by {person.ess:.0f} effective draws")
    for warning in _warnings(person):
        show(f"first pose: warning: {warning}")
    # The distances to the markers of the search are not residuals, since these markers were not measured.
    return poses_of(model, session, person, seed=seed)._replace(median_m=float("nan"))


def check_pictures(model: Model, session: Session) -> None:
    """Check that frame 0 has silhouettes, and that detectors see a person there.

    Raises:
        InputError: there are no silhouettes, no person is seen, or a file of frame 0 cannot be used.
    """
    _check_silhouettes(model, session)
    detected = detect(session, 0, TRUSTED)
    if TRUNK not in detected.parts:
        _nobody(detected, model, session)


def known_markers(model: Model) -> int:
    """Return how many markers of the search are markers of the model's body; with fewer than FEWEST no pose is fitted to them."""
    points = body_points(model.body.by_angles)
    return sum(points.index(name) is not None for name in MARKERS)


def poses_of(model: Model, session: Session, person: Found, frame: int = 0, seed: int = 0) -> FirstPose:
    """Return DRAWS equally likely poses of the model's body, and the likeliest of them: fitted to what was found, then refined (refine.py).

    Poses of a body that is placed by parts are fitted but not refined.

    Args:
        model: the model whose body is placed.
        session: the recording.
        person: what was found, markers in metres.
        frame: the frame in which it was found, counted from 0.
        seed: seed of the draws.

    Raises:
        InputError: the body has too few markers, the fit did not converge, or a file of the frame cannot be used.
    """
    estimate = fit_to(model, session, person, seed)
    if model.body.variable != POSE:
        return estimate
    exchanged = fit_to(model, session, person._replace(names=tuple(map(_other_leg, person.names))), seed)
    measured_frame = read_frame(session, frame)
    placed = [judge.at(measured_frame.cameras) if session.moves else judge for judge in _judges(model)]
    coarse, sharp = (everywhere(judge.density(judge.observe(measured_frame), judge.start(1))) for judge in placed)
    # Each facing keeps its share: one frame must not change what several frames have decided.
    is_main_way = _is_ahead(person)[_taken(person, seed)]
    poses = np.concatenate([np.asarray(pose_fit.draws, float) for pose_fit in (estimate, exchanged)])
    refined = [
        refine(model, (coarse, sharp), poses[np.concatenate([way, way])], int(way.sum()), seed) for way in (is_main_way, ~is_main_way) if way.any()
    ]
    draws = jnp.asarray(np.concatenate(refined).round(DIGITS))
    return estimate._replace(pose=draws[0], draws=draws)


def _judges(model: Model) -> tuple[Model, Model]:
    """Return the models whose likelihoods refine found poses: the model itself if it compares keypoints, else with the likelihoods of JUDGES.

    Many likelihoods reward a body inside the silhouette but ignore what it leaves uncovered; others say nothing about a single frame. With them, arms
    end up folded in front of the trunk.
    """
    if "keypoints" in model.reads:
        return model, model
    first, added = (with_likelihoods(model, name) for name in JUDGES)
    likelihoods = [factor for factor in added.factors if factor.side == "likelihood"]
    return first, replace(first, factors=(*likelihoods, *first.factors), observers={**first.observers, **added.observers})


def _is_ahead(person: Found) -> Bool[np.ndarray, " draw"]:
    """Return whether each draw faces the same way as the mean."""
    return _hip_axis(person.names, person.draws) @ _hip_axis(person.names, person.markers[None])[0] >= 0


def _taken(person: Found, seed: int) -> Int[np.ndarray, " taken"]:
    """Return the indices of DRAWS draws, resampled by weight."""
    weights = np.where(_is_ahead(person) | (person.turned >= LEAST_TURNED), person.weights, 0.0)
    with np.errstate(divide="ignore"):
        return np.asarray(resampled(jax.random.key(seed), np.log(weights), DRAWS))


def _other_leg(name: str) -> str:
    """Return the name of the same marker on the other leg; the given name if the marker is not on a leg."""
    return {"l": "r", "r": "l"}[name[0]] + name[1:] if LEG.match(name) else name


def fit_to(model: Model, session: Session, person: Found, seed: int = 0) -> FirstPose:
    """Return the model's pose that fits the main mode's mean markers, and DRAWS poses that fit the markers of DRAWS draws.

    Args:
        model: the model whose body is placed.
        session: the recording.
        person: what was found, markers in metres.
        seed: seed of the choice of draws.

    Raises:
        InputError: the body has too few markers, or the fit did not converge.
    """
    marker_count = known_markers(model)
    if marker_count < FEWEST:
        _raise_no_pose(f"no first pose, and the model's body has {marker_count} of the markers that are searched for, fewer than {FEWEST}", model)
    points = body_points(model.body.by_angles)
    taken = _taken(person, seed)
    drawn, is_main_way = person.draws[taken], _is_ahead(person)[taken]
    estimate, poses = _fit_way(model, session, points, person.names, person.markers, drawn)
    if not is_main_way.all():
        # Bodies that face the other way cannot start from the fit of the main way.
        poses = np.where(is_main_way[:, None], poses, _fit_way(model, session, points, person.names, drawn[~is_main_way].mean(axis=0), drawn)[1])
    return estimate._replace(source="searched", draws=jnp.asarray(poses.round(DIGITS)))


def _fit_way(
    model: Model,
    session: Session,
    points: Points,
    names: Sequence[str],
    mean: Float[np.ndarray, "marker 3"],
    drawn: Float[np.ndarray, "draw marker 3"],
) -> tuple[FirstPose, Float[np.ndarray, "draw dof"]]:
    """Return the pose that fits mean markers, and poses near it that fit each draw's markers."""
    of_mean = {name: (float(x), float(y), float(z)) for name, (x, y, z) in zip(names, mean, strict=True)}
    # The markers belong to a body of the same height, so they say nothing more about lengths.
    asked = replace(session, initial_markers=of_mean, fit_lengths=False)
    measurements = read_measurements(asked, points)
    problem = build_problem(model, asked, points, measurements)
    best = fit(problem, "xyz".index(session.up)).best
    places = np.zeros((len(drawn), len(points.names), 3))
    for number, name in enumerate(names):
        place = points.index(name)
        if place is not None:
            places[:, place] = drawn[:, number]
    starts = unbounded(problem, np.tile(best.pose, (len(drawn), 1)))
    poses = fit_draws(problem, starts, places)
    return tell(asked, points, measurements, best.distances, best.pose, {}), poses.astype(float)


def _hip_axis(names: Sequence[str], markers: Float[np.ndarray, "draw marker 3"]) -> Float[np.ndarray, "draw 3"]:
    return markers[:, names.index("l_hip")] - markers[:, names.index("r_hip")]


def _warnings(person: Found) -> Iterator[str]:
    if person.turned > MOST_TURNED:
        yield f"the person may face the other way, with a probability of {person.turned:.2f}; look at the overlay"
    if person.elsewhere - person.turned > MOST_ELSEWHERE:
        yield f"other poses have a probability of {person.elsewhere - person.turned:.2f}; look at the overlay"
    if person.ess < FEWEST_DRAWS:
        yield f"the search rests on {person.ess:.0f} effective draws; look at the overlay before you trust the track"


def _check_silhouettes(model: Model, session: Session) -> None:
    if read_frame(session, 0).masks is None:
        _raise_no_pose("no first pose, and no silhouettes in which to look for the person", model)


def _nobody(detected: Detected, model: Model, session: Session) -> NoReturn:
    why = f" ({'; '.join(detected.notices)})" if detected.notices else ""
    later_index = later_frame(session)
    but = "" if later_index is None else f", but one was in frame {session.frame_number(later_index)}"
    _raise_no_pose(f"no first pose, and no person was detected in frame {session.first_frame}{why}{but}", model)


def _raise_no_pose(problem: str, model: Model) -> NoReturn:
    problem = f"{problem}; the body '{model.body.name}' would start at the origin of the world"
    expected = "a person whose silhouette the cameras show in frame 0, or a first pose"
    remedy = (
        "start at a frame in which the person is seen, with --first-frame, or import the recording with --keypoints, or give four keypoints or "
        "more in each of two cameras under [initial.keypoints_px.CAMERA], or angles_deg and positions_m under [initial]"
    )
    raise input_error(PREFIX, problem, expected, remedy)
