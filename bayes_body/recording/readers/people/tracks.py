"""People over time: a person is opened when cameras agree in several frames, followed by motion, and closed when no two cameras see the person.

A person who comes back soon, at a place that can have been reached, and with the same lengths between keypoints, is the same one. What is flat and
does not move is a picture of a person.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from bayes_body.base.progress import Watch, unwatched
from bayes_body.recording.readers.keypoints.person import People
from bayes_body.recording.readers.people.bodies import sizes_of
from bayes_body.recording.readers.people.matching import Match, match_known, new_people
from bayes_body.recording.session.session import CameraSpec

# A person is closed after so many frames in which too few cameras see the person; after OPENED, if there were fewer sightings than that.
CLOSED, OPENED = 10, 4
# A shorter track is a ghost.
SHORTEST = 8
# New people are looked for in every so many frames: it takes as long as ten frames of following.
LOOK_EVERY = 3
# The velocity of a person is that of the last frames, with weights that fall by this factor, and slows down as fast where nobody is seen.
SMOOTHING = 0.7
# A person who was away for at most this time, seconds, may have moved so far, metres and metres a second, with lengths so alike (logarithm).
AWAY_S, NEAR_M, SPEED, ALIKE = 2.0, 0.3, 1.5, 0.08
# A picture: its keypoints are this near to a plane and to their places, metres (root mean square), for so many seconds at least.
FLAT_M, STILL_M, STILL_S = 0.015, 0.05, 1.0
# Two people are farther apart than this, metres: the median over their keypoints.
SAME_M = 0.2
# More people are not looked for: the largest in the image are taken.
MOST_PEOPLE = 12


@dataclass(eq=False)
class Track:
    """A person, as far as he or she was followed.

    Attributes:
        bodies: by frame in which enough cameras see the person.
        velocity: of the body, per frame.
    """

    bodies: dict[int, Float[np.ndarray, "keypoint _"]] = field(default_factory=dict)
    velocity: Float[np.ndarray, " _"] = field(default_factory=lambda: np.zeros(1))

    @property
    def first(self) -> int:
        """The first frame."""
        return min(self.bodies)

    @property
    def last(self) -> int:
        """The last frame."""
        return max(self.bodies)

    def predicted(self, frame: int) -> Float[np.ndarray, "keypoint _"]:
        """Return the body in a later frame, by its motion."""
        gone = frame - self.last
        travelled = self.velocity * sum(SMOOTHING**step for step in range(gone)) if gone > 1 else self.velocity
        return self.bodies[self.last] + travelled

    def see(self, frame: int, match: Match) -> None:
        """Take the body that a frame's detections show, if they show one."""
        body = match.body
        if body is None:
            return
        if self.bodies:
            gone = frame - self.last
            difference = body - self.bodies[self.last]
            difference = difference[np.isfinite(difference).all(axis=-1)]
            moved = np.median(difference, axis=0) / gone if len(difference) else self.velocity
            self.velocity = SMOOTHING * self.velocity + (1 - SMOOTHING) * moved if gone == 1 else moved
            # A keypoint that is not seen moves along.
            body = np.where(np.isfinite(body), body, self.predicted(frame))
        else:
            self.velocity = np.zeros(body.shape[-1])
        self.bodies[frame] = body


def limited(people: Sequence[Sequence[People]]) -> tuple[list[list[People]], int]:
    """Return the people of each frame and camera, at most MOST_PEOPLE of each, the largest in their order, and the largest number there was."""
    most = max((len(group) for frame in people for group in frame), default=0)
    if most <= MOST_PEOPLE:
        return [list(frame) for frame in people], most
    return [[_largest(group) for group in frame] for frame in people], most


def _largest(group: People) -> People:
    return group if len(group) <= MOST_PEOPLE else group[np.sort(np.argsort(-sizes_of(group), kind="stable")[:MOST_PEOPLE])]


def follow_people(cameras: Sequence[CameraSpec], people: Sequence[Sequence[People]], fps: float, watch: Watch = unwatched) -> list[Track]:
    """Return everybody who is in the recording, in the order of their first frames.

    Args:
        cameras: calibrated, without motion.
        people: for each frame and camera, column, row (pixels; NaN where not seen) and confidence.
        fps: frames per second.
        watch: shows how many frames are done.
    """
    current, ended = list[Track](), list[Track]()
    for frame in watch(range(len(people))):
        groups = people[frame]
        matches = match_known(cameras, groups, np.array([track.predicted(frame) for track in current])) if current else []
        for track, match in zip(current, matches, strict=True):
            track.see(frame, match)
        if frame % LOOK_EVERY == 0 or not current:
            current += _opened(cameras, groups, matches, current, frame)
        stopped = [track for track in current if _is_over(track, frame)]
        ended += stopped
        current = [track for track in current if track not in stopped]
    tracks = sorted((track for track in ended + current if len(track.bodies) >= min(SHORTEST, len(people))), key=lambda track: track.first)
    return [track for track in _joined(tracks, fps) if len(cameras) == 1 or not is_picture(track, fps)]


def _opened(cameras: Sequence[CameraSpec], groups: Sequence[People], matches: Sequence[Match], current: Sequence[Track], frame: int) -> list[Track]:
    """Return tracks of new people. Nobody can stand where somebody else is: such a body is the same person's, detected with faults."""
    taken = [{place for match in matches if (place := match.places[c]) is not None} for c in range(len(cameras))]
    tracks = list[Track]()
    for match in new_people(cameras, groups, taken):
        assert match.body is not None
        is_new = len(cameras) == 1 or all(_separation(track.predicted(frame), match.body) > SAME_M for track in (*current, *tracks))
        if is_new:
            tracks.append(Track())
            tracks[-1].see(frame, match)
    return tracks


def _separation(body: np.ndarray, rival: np.ndarray) -> float:
    """The median distance between the keypoints of two bodies that are known, metres."""
    separation = np.linalg.norm(body - rival, axis=-1)
    return float(np.median(separation[np.isfinite(separation)])) if np.isfinite(separation).any() else np.inf


def _is_over(track: Track, frame: int) -> bool:
    """Whether a person is no longer in view, or was a ghost: too few sightings to open a person."""
    return frame - track.last >= (CLOSED if len(track.bodies) >= OPENED else OPENED)


def _joined(tracks: Sequence[Track], fps: float) -> list[Track]:
    """Return the tracks with those of people who came back joined."""
    joined = list[Track]()
    for track in tracks:
        predecessors = [person for person in joined if _came_back(person, track, fps)]
        if not predecessors:
            joined.append(track)
            continue
        person = max(predecessors, key=lambda person: person.last)
        person.bodies |= track.bodies
    return joined


def _came_back(predecessor: Track, successor: Track, fps: float) -> bool:
    away_s = (successor.first - predecessor.last) / fps
    if not 0 < away_s <= AWAY_S or predecessor.bodies[predecessor.last].shape[-1] == 2:
        return False
    separation = _separation(successor.bodies[successor.first], predecessor.bodies[predecessor.last])
    return bool(separation <= NEAR_M + SPEED * away_s) and abs(_log_size(predecessor) - _log_size(successor)) <= ALIKE


def _log_size(track: Track) -> float:
    """The logarithm of a person's size: of the median distance between keypoints, over keypoints and frames."""
    bodies = _seen_bodies(track)
    return float(np.log(np.nanmedian(np.linalg.norm(bodies - np.nanmean(bodies, axis=1, keepdims=True), axis=-1))))


def _seen_bodies(track: Track) -> Float[np.ndarray, "frame keypoint _"]:
    """The bodies of a track, with the keypoints that were seen at some time."""
    bodies = np.array(list(track.bodies.values()))
    return bodies[:, np.isfinite(bodies).all(axis=-1).any(axis=0)]


def is_picture(track: Track, fps: float) -> bool:
    """Whether a track is a picture of a person, such as a poster: flat, and always at one place."""
    if track.last - track.first < STILL_S * fps:
        return False
    bodies = _seen_bodies(track)
    mean = np.nanmedian(bodies, axis=0)
    moved = np.nanmedian(np.linalg.norm(np.nanmedian(bodies, axis=1) - np.nanmedian(mean, axis=0), axis=-1))
    thickness = np.linalg.svd(mean - mean.mean(axis=0), compute_uv=False)[-1] / np.sqrt(len(mean))
    return bool(moved <= STILL_M and thickness <= FLAT_M)
