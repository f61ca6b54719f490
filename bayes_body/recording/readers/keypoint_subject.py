"""Follow the subject from frame to frame among the people that the cameras see.

`choose_person` finds the subject in the first frame. From then on, the subject in a camera is the person nearest to the projection of the previous
frame's body (with one camera: to the subject's place in the previous frame), if the distance is within a fifth of the person's size. Cameras that do
not agree with the body of this frame are dropped. If fewer than two cameras remain (with one camera: if no person is near), `choose_person` is called
again. If that fails too, the people who were near are used.
"""

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float

from bayes_body.recording.readers.person import FEWEST, SAME, People, choose_person
from bayes_body.recording.readers.triangulate import reprojection_errors, triangulate
from bayes_body.recording.session.session import CameraSpec

# Limit on the median distance to the projection of the previous body, as a fraction of the person's size in the image.
NEAR = 0.2

# With several cameras: the body's keypoints in the world, metres. With one camera: its keypoints in the image.
type Body = Float[np.ndarray, "keypoint _"]
type Places = tuple[int | None, ...]


def follow_person(cameras: Sequence[CameraSpec], frames: Iterable[Sequence[People]]) -> list[Places]:
    """The subject's index in each camera's list of people, frame by frame; None where the subject is not visible.

    Args:
        cameras: calibrated.
        frames: for each frame and camera, column, row (pixels; NaN where not visible) and confidence.
    """
    places, before = [], None
    for people in frames:
        near = tuple(_nearest(camera, among, before) for camera, among in zip(cameras, people, strict=True))
        subject = _agreeing(cameras, people, near, before)
        if subject is None:
            chosen = choose_person(cameras, people)
            subject = near if chosen is None else chosen.places
        before = _body(cameras, people, subject, before)
        places.append(subject)
    return places


def _agreeing(cameras: Sequence[CameraSpec], people: Sequence[People], near: Places, before: Body | None) -> Places | None:
    """The people who are near and agree with the body of this frame; None if too few cameras see it."""
    if len(cameras) > 1 and _count(near) > 1:
        body = _body(cameras, people, near, before)
        rows = zip(cameras, people, near, strict=True)
        near = tuple(place if place is not None and _error(camera, body, among[place]) <= SAME else None for camera, among, place in rows)
    return near if _count(near) >= min(2, len(cameras)) else None


def _count(places: Places) -> int:
    return sum(place is not None for place in places)


def _nearest(camera: CameraSpec, people: People, body: Body | None) -> int | None:
    errors = [_error(camera, body, person) for person in people]
    error = min(errors, default=np.inf)
    return errors.index(error) if error <= NEAR else None


def _body(cameras: Sequence[CameraSpec], people: Sequence[People], places: Places, before: Body | None) -> Body | None:
    """The body of this frame. If too little of it is known, the body of the previous frame."""
    visible = [(camera, among[place]) for camera, among, place in zip(cameras, people, places, strict=True) if place is not None]
    if len(visible) < min(2, len(cameras)):
        return before
    body = (
        visible[0][1][:, :2]
        if len(cameras) == 1
        else triangulate([camera for camera, _ in visible], np.stack([person for _, person in visible])).points_m
    )
    return body if np.isfinite(body).all(axis=1).sum() >= FEWEST else before


def _error(camera: CameraSpec, body: Body | None, person: Float[np.ndarray, "keypoint 3"]) -> float:
    """Median distance between a body and a person in the image, as a fraction of the person's size; infinite if they share too few keypoints."""
    visible = person[np.isfinite(person[:, :2]).all(axis=1), :2]
    if body is None or len(visible) < FEWEST:
        return np.inf
    apart = np.linalg.norm(body - person[:, :2], axis=1) if body.shape[1] == 2 else reprojection_errors([camera], body, person[None])[0]
    known = apart[~np.isnan(apart)]
    size = float(np.linalg.norm(np.ptp(visible, axis=0)))
    return float(np.median(known)) / size if len(known) >= FEWEST and size > 0 else np.inf
