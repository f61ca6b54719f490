"""Find the subject among the people that each camera sees.

With several cameras: the person on whom most cameras agree; if several qualify, the one with the smallest error. The six largest people of each
camera are candidates. Every pair of candidates from two cameras gives a body by triangulation. A further camera agrees if one of its people is near
the body's projection, within a tenth of the person's size in the image. With one camera: the largest person.
"""

from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.recording.readers.keypoints.triangulate import reprojection_errors, triangulate
from bayes_body.recording.session.session import CameraSpec

# Limit on the median distance between a person and a body's projection, as a fraction of the person's size in the image.
SAME = 0.1
# The same for the projection of the previous frame's body.
NEAR = 0.2
# In a crowd, all pairs would take minutes, and the subject is unlikely to be only the seventh by size.
MOST_PROPOSERS = 6
# Two detections nearer than this are one person, detected twice; people who overlap differ by more.
REPEATED = 0.02
# With fewer common keypoints a comparison is meaningless.
FEWEST = 5

# For one camera: (person, keypoint, 3) with column, row (pixels; NaN where not seen), confidence. Cameras see different numbers of people.
type People = Float[np.ndarray, "_ _ 3"]


class Chosen(NamedTuple):
    """The subject.

    Attributes:
        places: the index in each camera's list of people; None where the subject is not seen.
        error: median distance to the body's projection, as a fraction of the person's size in the image, averaged over cameras.
    """

    places: tuple[int | None, ...]
    error: float


def choose_person(cameras: Sequence[CameraSpec], people: Sequence[People]) -> Chosen | None:
    """The subject among the people that cameras see at the same time (see the module); None if it cannot be determined.

    Args:
        cameras: calibrated.
        people: for each camera, column, row (pixels; NaN where not seen) and confidence.
    """
    if len(cameras) == 1:
        sizes = [_size(person) for person in people[0]]
        return Chosen((int(np.argmax(sizes)),), 0.0) if any(sizes) else None
    candidates = dict.fromkeys(_extended(cameras, people, seed) for seed in _seeds(people))
    chosen = [Chosen(places, _error(cameras, people, places)) for places in candidates if places is not None]
    return min(chosen, key=lambda choice: (choice.places.count(None), choice.error), default=None)


def _seeds(people: Sequence[People]) -> Iterator[dict[int, int]]:
    largest = [sorted(range(len(group)), key=lambda i, group=group: -_size(group[i]))[:MOST_PROPOSERS] for group in people]
    for a, b in combinations(range(len(people)), 2):
        yield from ({a: i, b: j} for i in largest[a] for j in largest[b])


def _extended(cameras: Sequence[CameraSpec], people: Sequence[People], seed: dict[int, int]) -> tuple[int | None, ...] | None:
    """Extend a pair of people in two cameras to all cameras that agree; None if the two are not the same person."""
    points = triangulate([cameras[c] for c in seed], np.stack([people[c][i] for c, i in seed.items()]), np.inf).points_m
    places: list[int | None] = []
    for c, camera in enumerate(cameras):
        among = [seed[c]] if c in seed else range(len(people[c]))
        errors = [(relative_error(camera, points, people[c][i]), i) for i in among]
        error, place = min(errors, default=(np.inf, 0))
        if c in seed and error > SAME:
            return None
        places.append(place if error <= SAME else None)
    return tuple(places)


def _error(cameras: Sequence[CameraSpec], people: Sequence[People], places: Sequence[int | None]) -> float:
    seeing = [c for c, place in enumerate(places) if place is not None]
    persons = [people[c][place] for c, place in enumerate(places) if place is not None]
    points = triangulate([cameras[c] for c in seeing], np.stack(persons), np.inf).points_m
    return float(np.mean([relative_error(cameras[c], points, person) for c, person in zip(seeing, persons, strict=True)]))


def relative_error(camera: CameraSpec, points_m: Float[np.ndarray, "keypoint 3"], person: Float[np.ndarray, "keypoint 3"]) -> float:
    """Median distance between a body's projection and a person, as a fraction of the person's size; infinite if they share too few keypoints.

    Args:
        camera: calibrated.
        points_m: the body's points in the world, metres; NaN where not known.
        person: column, row (pixels; NaN where not seen) and confidence.
    """
    errors = reprojection_errors([camera], points_m, person[None])[0]
    errors_px = errors[~np.isnan(errors)]
    return float(np.median(errors_px)) / _size(person) if len(errors_px) >= FEWEST else np.inf


def _size(person: Float[np.ndarray, "keypoint 3"]) -> float:
    """Diagonal of the bounding box of a person, pixels; 0 if no keypoint is known."""
    points = person[np.isfinite(person[:, :2]).all(axis=1), :2]
    return float(np.linalg.norm(np.ptp(points, axis=0))) if len(points) else 0.0


def distinct_people(people: People) -> People:
    """The people of a frame without repeated detections of the same person: of these, the most confident one. Their order stays."""
    chosen: list[int] = []
    for k in np.argsort(-people[..., 2].sum(axis=1), kind="stable") if len(people) > 1 else range(len(people)):
        if not any(_is_repeated(people[k], people[i]) for i in chosen):
            chosen.append(int(k))
    return people[sorted(chosen)]


def _is_repeated(person: Float[np.ndarray, "keypoint 3"], rival: Float[np.ndarray, "keypoint 3"]) -> bool:
    distances = np.linalg.norm(person[:, :2] - rival[:, :2], axis=1)
    distances = distances[np.isfinite(distances)]
    return len(distances) >= FEWEST and float(np.median(distances)) < REPEATED * _size(rival)
