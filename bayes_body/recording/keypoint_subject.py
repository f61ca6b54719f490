"""The same person from frame to frame, among the people that cameras see.

The first frame's is chosen by `choose_person`. From then on somebody in a camera is the subject who is nearest to where the body of the frame before
projects to (with one camera: to where it was), if that is within a fifth of the person's size; cameras that then do not agree with the body of this
frame are left out. Where fewer than two cameras are left (with one camera: nobody is near), the choice is made anew; if nobody can be told, whoever
is near still counts.
"""

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float

from bayes_body.recording.person import FEWEST, SAME, People, choose_person
from bayes_body.recording.triangulate import reprojection_errors, triangulate
from bayes_body.session.session import CameraSpec

# Median distance to the projection of the body of the frame before, of the person's size in the image.
NEAR = 0.2

# Of several cameras the body's keypoints in the world, metres; of one camera those in its image.
type Body = Float[np.ndarray, "keypoint _"]
type Places = tuple[int | None, ...]


def follow_person(cameras: Sequence[CameraSpec], frames: Iterable[Sequence[People]]) -> list[Places]:
    """The subject's place in each camera's list of people, frame by frame; None where the subject is not seen.

    Args:
        cameras: calibrated.
        frames: for each frame and camera, column, row (pixels; NaN where not seen) and confidence.
    """
    places, before = [], None
    for people in frames:
        near = tuple(_nearest(camera, among, before) for camera, among in zip(cameras, people, strict=True))
        found = _agreeing(cameras, people, near, before)
        if found is None:
            chosen = choose_person(cameras, people)
            found = near if chosen is None else chosen.places
        before = _body(cameras, people, found, before)
        places.append(found)
    return places


def _agreeing(cameras: Sequence[CameraSpec], people: Sequence[People], near: Places, before: Body | None) -> Places | None:
    """Those who are near and where the body of this frame is; None where too few cameras see it."""
    if len(cameras) > 1 and _count(near) > 1:
        now = _body(cameras, people, near, before)
        rows = zip(cameras, people, near, strict=True)
        near = tuple(place if place is not None and _error(camera, now, among[place]) <= SAME else None for camera, among, place in rows)
    return near if _count(near) >= min(2, len(cameras)) else None


def _count(places: Places) -> int:
    return sum(place is not None for place in places)


def _nearest(camera: CameraSpec, people: People, body: Body | None) -> int | None:
    errors = [_error(camera, body, person) for person in people]
    error = min(errors, default=np.inf)
    return errors.index(error) if error <= NEAR else None


def _body(cameras: Sequence[CameraSpec], people: Sequence[People], places: Places, before: Body | None) -> Body | None:
    """What is known of the body in this frame; what was known before where that is too little."""
    seen = [(camera, among[place]) for camera, among, place in zip(cameras, people, places, strict=True) if place is not None]
    if len(seen) < min(2, len(cameras)):
        return before
    now = seen[0][1][:, :2] if len(cameras) == 1 else triangulate([camera for camera, _ in seen], np.stack([person for _, person in seen])).points_m
    return now if np.isfinite(now).all(axis=1).sum() >= FEWEST else before


def _error(camera: CameraSpec, body: Body | None, person: Float[np.ndarray, "keypoint 3"]) -> float:
    """Median distance between a body and a person in the image, of the person's size; infinite where they have little in common."""
    seen = person[np.isfinite(person[:, :2]).all(axis=1), :2]
    if body is None or len(seen) < FEWEST:
        return np.inf
    apart = np.linalg.norm(body - person[:, :2], axis=1) if body.shape[1] == 2 else reprojection_errors([camera], body, person[None])[0]
    known = apart[~np.isnan(apart)]
    size = float(np.linalg.norm(np.ptp(seen, axis=0)))
    return float(np.median(known)) / size if len(known) >= FEWEST and size > 0 else np.inf
