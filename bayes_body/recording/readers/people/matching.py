"""Which detections of a frame belong together: to people who were there before, and to new ones.

A known person is where the motion leads. In each camera, detections and known people are paired one to one, so that the sum of their distances is
least. Of the detections of a person, those stay that agree with the body that they show together.

New people come from detections that nobody explains. Every pair of them from two cameras gives a body. Other cameras agree if they have a detection
near its projection; each detection belongs to one body only. So the choice is consistent around every cycle of cameras. The body on which most
cameras agree is taken first.
"""

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment

from bayes_body.recording.readers.keypoints.person import NEAR, SAME, People
from bayes_body.recording.readers.people.bodies import Bodies, bodies_of, body_of, distances, distances_in_all
from bayes_body.recording.session.session import CameraSpec

type Places = tuple[int | None, ...]
# Share of the error that is accepted without looking for cameras that are wrong about a keypoint.
CLEARLY = 0.5
# Stands for a pair that is too far apart.
FAR = 1e3


class Match(NamedTuple):
    """A person's detection in every camera, None where there is none; and the body that they show, None if too few cameras see it."""

    places: Places
    body: Float[np.ndarray, "keypoint _"] | None


def match_known(cameras: Sequence[CameraSpec], people: Sequence[People], bodies: Bodies) -> list[Match]:
    """Return the match of each known person.

    Args:
        cameras: calibrated.
        people: for each camera.
        bodies: where the known people should be.
    """
    chosen = [[None] * len(cameras) for _ in bodies]
    for c, (misfits, group) in enumerate(zip(distances_in_all(cameras, bodies, people), people, strict=True)):
        costs = np.where(misfits[:, : len(group)] <= NEAR, misfits[:, : len(group)], FAR)
        for body, place in zip(*linear_sum_assignment(costs), strict=True):
            if costs[body, place] < FAR:
                chosen[body][c] = int(place)
    if len(cameras) == 1:
        return [agreeing(cameras, people, tuple(places)) for places in chosen]
    shown = bodies_of(cameras, people, chosen, bodies.shape[1])
    return [_match(cameras, people, tuple(places), body, misfit) for places, body, misfit in zip(chosen, *shown, strict=True)]


def _match(cameras: Sequence[CameraSpec], people: Sequence[People], places: Places, body: np.ndarray, misfit: float) -> Match:
    """Return the match of a person whose detections show a body with some largest distance."""
    is_seen = len(places) - places.count(None) >= 2
    if is_seen and misfit <= CLEARLY * SAME:
        return Match(places, body)
    return agreeing(cameras, people, places, is_seen and bool(np.isfinite(misfit)))


def agreeing(cameras: Sequence[CameraSpec], people: Sequence[People], places: Places, is_doubtful: bool = False) -> Match:
    """Return the places without the detections that disagree with the body that all show, the farthest first.

    Args:
        cameras: calibrated.
        people: for each camera.
        places: the chosen detection of each camera; None for none.
        is_doubtful: whether it is known that they do not clearly agree.
    """
    count = sum(place is not None for place in places)
    if len(cameras) == 1 or count < 2:
        return Match(places, body_of(cameras, people, places))
    misfits = list[float]()
    attempts = [(True, SAME)] if is_doubtful else [(False, CLEARLY * SAME), (True, SAME)]
    for is_robust, limit in attempts:
        body = body_of(cameras, people, places, is_robust)
        if body is None:
            return Match((None,) * len(places), None)
        misfits = [0.0 if place is None else _distance(cameras[c], body, people[c], place) for c, place in enumerate(places)]
        if max(misfits) <= limit:
            return Match(places, body)
    if count == 2:
        return Match((None,) * len(places), None)
    worst = int(np.argmax(misfits))
    return agreeing(cameras, people, tuple(None if c == worst else place for c, place in enumerate(places)))


def _distance(camera: CameraSpec, body: np.ndarray, group: People, place: int) -> float:
    return float(distances(camera, body[None], group[place : place + 1])[0, 0])


def new_people(cameras: Sequence[CameraSpec], people: Sequence[People], taken: Sequence[set[int]]) -> list[Match]:
    """Return the matches of people among the detections that are not taken.

    Args:
        cameras: calibrated.
        people: for each camera.
        taken: for each camera, the detections that known people explain.
    """
    free = [set(range(len(group))) - used for group, used in zip(people, taken, strict=True)]
    if len(cameras) == 1:
        matches = (Match((place,), body_of(cameras, people, (place,))) for place in sorted(free[0]))
        return [match for match in matches if match.body is not None]
    proposals = {match.places: match for pair in combinations(range(len(cameras)), 2) for match in _of_pair(cameras, people, free, *pair)}
    ranked = sorted(proposals.values(), key=lambda match: (match.places.count(None), _misfit(cameras, people, match)))
    chosen = list[Match]()
    for match in ranked:
        if all(place is None or place in free[c] for c, place in enumerate(match.places)):
            chosen.append(match)
            for c, place in enumerate(match.places):
                free[c].discard(-1 if place is None else place)
    return chosen


def _of_pair(cameras: Sequence[CameraSpec], people: Sequence[People], free: Sequence[set[int]], a: int, b: int) -> list[Match]:
    """Return the matches that the pairs of free detections of two cameras lead to."""
    proposals = list[Match]()
    for i in free[a]:
        for j in free[b]:
            pair = tuple(i if c == a else j if c == b else None for c in range(len(cameras)))
            body = body_of(cameras, people, pair)
            if body is None or max(_distance(cameras[a], body, people[a], i), _distance(cameras[b], body, people[b], j)) > SAME:
                continue
            match = agreeing(cameras, people, _extended(cameras, people, free, pair, body))
            if match.body is not None:
                proposals.append(match)
    return proposals


def _extended(cameras: Sequence[CameraSpec], people: Sequence[People], free: Sequence[set[int]], pair: Places, body: np.ndarray) -> Places:
    """Return a pair with the nearest free detection of every other camera, if it is near enough."""
    places = list(pair)
    for c, place in enumerate(pair):
        candidates = sorted(free[c])
        if place is None and candidates:
            misfits = distances(cameras[c], body[None], people[c][candidates])[0]
            places[c] = candidates[int(misfits.argmin())] if misfits.min() <= SAME else None
    return tuple(places)


def _misfit(cameras: Sequence[CameraSpec], people: Sequence[People], match: Match) -> float:
    assert match.body is not None
    return float(np.mean([_distance(cameras[c], match.body, people[c], place) for c, place in enumerate(match.places) if place is not None]))
