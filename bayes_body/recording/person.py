"""Which of the people that each camera sees is the subject.

Several cameras: the person on whom most cameras agree, and among these the one with the smallest error. Every two people in two cameras propose a
body, of the six that are largest in each; a further camera agrees if somebody in it is where the body projects to, within a tenth of the person's
size in the image. One camera: the largest person.
"""

from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.recording.triangulate import reprojection_errors, triangulate
from bayes_body.session.session import CameraSpec

# Median distance between a person and a body's projection, of the person's size in the image, up to which they are the same.
SAME = 0.1
# In a crowd all pairs of people would take minutes, and the subject is hardly the seventh by size.
MOST_PROPOSERS = 6
# Fewer keypoints in common say nothing.
FEWEST = 5

# Of one camera: person, keypoint, and column, row (pixels; NaN where not seen), confidence. Cameras see different numbers of people.
type People = Float[np.ndarray, "_ _ 3"]


class Chosen(NamedTuple):
    """The subject.

    Attributes:
        places: in each camera's list of people, None where the subject is not seen.
        error: median distance to the body's projection, of the person's size in the image, averaged over cameras.
    """

    places: tuple[int | None, ...]
    error: float


def choose_person(cameras: Sequence[CameraSpec], people: Sequence[People]) -> Chosen | None:
    """The subject among the people that cameras see at the same time (see the module); None where nobody can be told.

    Args:
        cameras: calibrated.
        people: for each camera, column, row (pixels; NaN where not seen) and confidence.
    """
    if len(cameras) == 1:
        sizes = [_size(person) for person in people[0]]
        return Chosen((int(np.argmax(sizes)),), 0.0) if any(sizes) else None
    candidates = dict.fromkeys(_grown(cameras, people, seed) for seed in _seeds(people))
    chosen = [Chosen(places, _error(cameras, people, places)) for places in candidates if places is not None]
    return min(chosen, key=lambda each: (each.places.count(None), each.error), default=None)


def _seeds(people: Sequence[People]) -> Iterator[dict[int, int]]:
    largest = [sorted(range(len(each)), key=lambda i, each=each: -_size(each[i]))[:MOST_PROPOSERS] for each in people]
    for a, b in combinations(range(len(people)), 2):
        yield from ({a: i, b: j} for i in largest[a] for j in largest[b])


def _grown(cameras: Sequence[CameraSpec], people: Sequence[People], seed: dict[int, int]) -> tuple[int | None, ...] | None:
    """Who agrees with the body of two people in two cameras, by camera; None if these two are not the same."""
    points = triangulate([cameras[c] for c in seed], np.stack([people[c][i] for c, i in seed.items()]), np.inf).points_m
    places: list[int | None] = []
    for c, camera in enumerate(cameras):
        among = [seed[c]] if c in seed else range(len(people[c]))
        errors = [(_relative_error(camera, points, people[c][i]), i) for i in among]
        error, place = min(errors, default=(np.inf, 0))
        if c in seed and error > SAME:
            return None
        places.append(place if error <= SAME else None)
    return tuple(places)


def _error(cameras: Sequence[CameraSpec], people: Sequence[People], places: Sequence[int | None]) -> float:
    seeing = [c for c, place in enumerate(places) if place is not None]
    persons = [people[c][place] for c, place in enumerate(places) if place is not None]
    points = triangulate([cameras[c] for c in seeing], np.stack(persons), np.inf).points_m
    return float(np.mean([_relative_error(cameras[c], points, person) for c, person in zip(seeing, persons, strict=True)]))


def _relative_error(camera: CameraSpec, points_m: Float[np.ndarray, "keypoint 3"], person: Float[np.ndarray, "keypoint 3"]) -> float:
    """Median distance between a body's projection and a person, of the person's size; infinite where they have little in common."""
    errors = reprojection_errors([camera], points_m, person[None])[0]
    known = errors[~np.isnan(errors)]
    return float(np.median(known)) / _size(person) if len(known) >= FEWEST else np.inf


def _size(person: Float[np.ndarray, "keypoint 3"]) -> float:
    """Diagonal of the box around a person, pixels; 0 for nobody."""
    seen = person[np.isfinite(person[:, :2]).all(axis=1), :2]
    return float(np.linalg.norm(np.ptp(seen, axis=0))) if len(seen) else 0.0
