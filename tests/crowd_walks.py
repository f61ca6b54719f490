"""Films without pictures of several people in `room_4`, and what a keypoint network writes of them: people in random order, and its usual errors."""

import os
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from keypoint_walks import RIG, Network, Person, person_of, seen_by

from bayes_body.base.files.shipped import definitions_folder
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.readers.rig import read_rig
from bayes_body.workshop.learning.walking_cycle import load_cycle, walk
from bayes_body.workshop.simulation.session_files import CALIBRATION, write_calibration, write_detections
from bayes_body.workshop.simulation.visibility import pixels

# Two markers and the radius of the part between them, metres: what hides somebody behind.
PARTS = (
    *(("pelvis", "thorax", 0.15), ("thorax", "head", 0.09), ("l_shoulder", "r_shoulder", 0.10), ("l_hip", "r_hip", 0.12)),
    *((f"{side}_{upper}", f"{side}_{lower}", radius) for side in "lr" for upper, lower, radius in (("hip", "knee", 0.08), ("knee", "ankle", 0.06))),
    *((f"{side}_{upper}", f"{side}_{lower}", 0.05) for side in "lr" for upper, lower in (("shoulder", "elbow"), ("elbow", "wrist"))),
)
# A part hides what is this much farther away, metres. A network does not detect a person with fewer keypoints.
BEHIND_M, FEWEST = 0.15, 5
# The speed of all walkers, m/s, and the least and the largest distance at which two who cross pass each other, metres.
PACE, PASS_M = 1.25, (0.55, 1.2)
# Curves that are drawn before a length counts as too short for two crossings.
MOST_TRIES = 5000


class Member(NamedTuple):
    """Somebody in a film.

    Attributes:
        number: from 1; the network's errors with this person depend on it, not on who else is there.
        person: the true markers in all frames, also in those in which nobody sees the person.
        present: (frame,), whether the person is there.
        cameras: the cameras that can see the person; all if empty.
    """

    number: int
    person: Person
    present: np.ndarray
    cameras: tuple[str, ...] = ()


class Film(NamedTuple):
    """People before the cameras of the rig. `cameras` are the names of those that are there; all if empty."""

    members: tuple[Member, ...]
    cameras: tuple[str, ...] = ()

    @property
    def rig(self):
        rig = read_rig(definitions_folder() / "rigs" / f"{RIG}.toml")
        return rig.select(list(self.cameras)) if self.cameras else rig

    def alone(self, number):
        """The same film of one person, for whom the network makes the same errors."""
        return self._replace(members=tuple(member for member in self.members if member.number == number))


class CrowdNetwork(NamedTuple):
    """What a keypoint network makes of people.

    Attributes:
        keypoints: errors of single keypoints.
        doubled: share of detections that are there twice, the second time a little elsewhere.
        swapped: share of detections with left and right exchanged.
        missed: share of detections that are missing.
    """

    keypoints: Network = Network(outliers=0.05, missing=0.05)
    doubled: float = 0.05
    swapped: float = 0.05
    missed: float = 0.03


class Detections(NamedTuple):
    """What the network writes: `points[camera][frame]` (detection, 15, 3), column, row, confidence, NaN where not seen; and `numbers[camera][frame]`
    (detection,), the number of the person that a detection is of."""

    points: list[list[np.ndarray]]
    numbers: list[list[np.ndarray]]


def stroll(frames, seed, curve=None, height_m=None, mirrored=False):
    """Landmarks of a walker of an arbitrary gait and stature along a curve in the floor, (point, 2), metres; along x from the origin without one."""
    rig, cycle = Film(()).rig, load_cycle()
    height_m = height_m or float(np.random.default_rng((seed, 5)).uniform(1.55, 1.92))
    usual = walk(cycle, frames / rig.fps, rig.fps, seed=seed, height_m=height_m)
    speed = (usual["pelvis"][-1, 0] - usual["pelvis"][0, 0]) * rig.fps / (frames - 1)
    straight = walk(cycle, frames / rig.fps, rig.fps, speed=PACE / speed, seed=seed, height_m=height_m)
    if mirrored:
        straight = {_mirrored(name): track * (1, -1, 1) for name, track in straight.items()}
    return straight if curve is None else _bent(straight, np.asarray(curve, float))


def _mirrored(name):
    return {"l_": "r_", "r_": "l_"}.get(name[:2], name[:2]) + name[2:]


def _bent(landmarks, curve):
    """The walk along x, along a curve: at each moment the whole body is turned about the vertical through the mean path."""
    frames = np.arange(len(landmarks["pelvis"]))
    way = np.polyval(np.polyfit(frames, landmarks["pelvis"][:, 0], 1), frames)
    way = way - landmarks["pelvis"][0, 0]
    places = _at(curve, way)
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    assert way.max() <= lengths[-1], f"the curve has {lengths[-1]:.1f} m, the walk {way.max():.1f} m"
    headings = np.unwrap(np.arctan2(*np.diff(curve, axis=0).T[::-1]))
    headings = np.interp(way, (lengths[1:] + lengths[:-1]) / 2, headings)
    c, s = np.cos(headings), np.sin(headings)
    ahead = np.stack([c, s], axis=1), np.stack([-s, c], axis=1)
    return {
        name: np.column_stack([places + (track[:, :1] - way[:, None]) * ahead[0] + track[:, 1:2] * ahead[1], track[:, 2]])
        for name, track in landmarks.items()
    }


def standing(frames, seed, at, heading):
    """Landmarks of a person who stands upright with hanging arms and sways by a centimetre or two."""
    rng = np.random.default_rng((seed, 6))
    walker = stroll(60, seed)
    sizes = {name: np.median(np.linalg.norm(walker[name] - walker[parent], axis=1)) for name, parent in _BELOW.items()}
    points = {name: np.median(walker[name] - walker["pelvis"], axis=0) for name in ("pelvis", "thorax", "head")}
    for side, sign in (("l", 1.0), ("r", -1.0)):
        for joint in ("hip", "shoulder"):
            across = np.median(np.linalg.norm(walker[f"l_{joint}"] - walker[f"r_{joint}"], axis=1)) / 2
            points[f"{side}_{joint}"] = np.array([0.0, sign * across, points["thorax"][2] - 0.02 if joint == "shoulder" else 0.0])
        for name in (f"{side}_knee", f"{side}_ankle", f"{side}_elbow", f"{side}_wrist"):
            forward = 0.25 if name.endswith("wrist") else 0.03
            points[name] = points[_BELOW[name]] + sizes[name] * np.array([np.sin(forward), 0.06 * sign, -np.cos(forward)])
    floor = min(points[f"{side}_ankle"][2] for side in "lr") - 0.08
    seconds, phases = np.arange(frames) / Film(()).rig.fps, rng.uniform(0, 2 * np.pi, 2)
    sway = 0.015 * np.stack([np.sin(2 * np.pi * 0.3 * seconds + phases[0]), np.sin(2 * np.pi * 0.23 * seconds + phases[1])], axis=1)
    turn = np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
    tracks = {}
    for name, point in points.items():
        height = point[2] - floor
        tracks[name] = np.column_stack([point[:2] @ turn + at + sway * height, np.full(frames, height)])
    return tracks


_BELOW = {
    f"{side}_{end}": f"{side}_{base}"
    for side in "lr"
    for end, base in (("knee", "hip"), ("ankle", "knee"), ("elbow", "shoulder"), ("wrist", "elbow"))
}


def poster(frames, seed, corner=(-0.4, 2.98, 0.9), side=(1.0, 0.0, 0.0), size=0.6):
    """Landmarks of a person printed on a wall: the points of a standing person in a plane, that do not move."""
    points = standing(1, seed, (0.0, 0.0), np.pi / 2)
    return {
        name: np.repeat((np.add(corner, size * track[:, :1] * np.array(side)) + size * track[:, 2:] * (0, 0, 1)), frames, axis=0)
        for name, track in points.items()
    }


def member(number, landmarks, known=False, present=slice(None), cameras=()):
    """A member of a film; `known` as in `person_of`, and `present` the frames in which the person is there."""
    is_there = np.zeros(len(landmarks["pelvis"]), bool)
    is_there[present] = True
    return Member(number, person_of(landmarks, known), is_there, tuple(cameras))


def crossing_curves(seed, length_m):
    """Two curves that cross twice if each is walked for a length; two people of the same pace pass each other by about a metre, `PASS_M`.

    They are waves of opposite sign, one a little ahead of the other, or circles.
    """
    rng, steps = np.random.default_rng((seed, 8)), np.linspace(0, 1.2 * length_m, 400)
    for _ in range(MOST_TRIES):
        turn = rng.uniform(0, 2 * np.pi)
        R = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        curves = [curve @ R for curve in (_waves if seed % 2 == 0 else _circles)(rng, steps, length_m)]
        walked = [_at(curve, np.linspace(0, length_m, 80)) for curve in curves]
        nearest = np.linalg.norm(walked[0] - walked[1], axis=1).min()
        if PASS_M[0] < nearest < PASS_M[1] and count_crossings(*walked) == count_crossings(*(way[8:-8] for way in walked)) == 2:
            return curves
    raise ValueError(f"no such curves of {length_m:.1f} m: give more frames")


def _waves(rng, steps, length_m):
    ahead, period = rng.uniform(0.25, 0.45), rng.uniform(0.85, 1.05) * length_m
    return [np.stack([steps - length_m / 2 + sign * ahead, sign * 0.42 * np.cos(2 * np.pi * steps / period)], axis=1) for sign in (1, -1)]


def _circles(rng, steps, length_m):
    curves = []
    for centre in (0.3, -0.3):
        radius, phase = rng.uniform(0.75, 1.2), rng.uniform(0, 2 * np.pi)
        curves.append(np.stack([centre + radius * np.cos(phase + steps / radius), radius * np.sin(phase + steps / radius)], axis=1))
    return curves


def _at(curve, lengths):
    """The points of a curve after some lengths of way, (length, 2)."""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    return np.stack([np.interp(lengths, way, axis) for axis in curve.T], axis=1)


def count_crossings(first, second):
    """How many times two lines (point, 2) cross."""

    def side(a, b, p):
        return (b[..., 0] - a[..., 0]) * (p[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (p[..., 0] - a[..., 0])

    a, b, c, d = first[:-1, None], first[1:, None], second[None, :-1], second[None, 1:]
    return int(((side(a, b, c) * side(a, b, d) < 0) & (side(c, d, a) * side(c, d, b) < 0)).sum())


def crossing_film(seed, frames=180, known=False):
    """Two people of different gait and stature whose paths cross twice. The second one's gait is mirrored."""
    curves = crossing_curves(seed, PACE * frames / Film(()).rig.fps)
    walkers = [stroll(frames, 2 * seed + number, curve, mirrored=number == 1) for number, curve in enumerate(curves)]
    return Film(tuple(member(number, landmarks, known) for number, landmarks in enumerate(walkers, 1)))


def door_film(seed, frames=200, leaves=80, enters=120, known=False, cameras=("C1", "C2", "C3")):
    """Three people: one walks about in the middle; one walks out of a door and is not there from frame `leaves` on; one comes in at `enters`."""
    circle = np.linspace(0.0, 2 * np.pi, 400)
    rng = np.random.default_rng((seed, 9))
    around = stroll(frames, 3 * seed, 0.9 * np.stack([np.cos(circle), np.sin(circle)], axis=1))
    leaving = _placed(stroll(frames, 3 * seed + 1), (1.9, -1.1), rng.uniform(-0.2, 0.2), leaves)
    entering = _placed(stroll(frames, 3 * seed + 2), (-1.9, 1.1), rng.uniform(-0.2, 0.2), enters)
    presences = slice(None), slice(None, leaves), slice(enters, None)
    members = zip((around, leaving, entering), presences, strict=True)
    return Film(tuple(member(number, landmarks, known, present) for number, (landmarks, present) in enumerate(members, 1)), tuple(cameras))


def _placed(landmarks, at, heading, frame):
    """The landmarks turned to a heading, with the pelvis above a place in a frame."""
    c, s = np.cos(heading), np.sin(heading)
    R = np.array([[c, s], [-s, c]])
    origin = landmarks["pelvis"][frame, :2]
    return {name: np.column_stack([(track[:, :2] - origin) @ R + at, track[:, 2]]) for name, track in landmarks.items()}


def background_film(seed, frames=120, known=False):
    """One who walks, and one who stands still in the background."""
    walker = _placed(stroll(frames, seed), (0.0, -0.3), 0.1 * seed, frames // 2)
    return Film((member(1, walker, known), member(2, standing(frames, seed + 50, np.array([-0.9, 1.5]), -1.2), known)))


def poster_film(seed, frames=120, known=False, cameras=("C3", "C4")):
    """One who walks, and one in a poster on a wall that `cameras` see: the network detects that one in almost all frames."""
    walker = _placed(stroll(frames, seed), (0.0, 0.0), 0.1 * seed, frames // 2)
    return Film((member(1, walker, known), member(2, poster(frames, seed + 70), False, cameras=cameras)))


def detect(film, network=CrowdNetwork(), seed=0):
    """What the network writes of a film: see `Detections`."""
    cameras = film.rig.cameras
    copies = [_detected(member, cameras, network, seed) for member in film.members]
    rng, points, numbers = np.random.default_rng((seed, 4)), [], []
    for c, camera in enumerate(cameras):
        hidden = _hidden(camera, film.members)
        frames_points, frames_numbers = [], []
        for frame in range(len(film.members[0].present)):
            rows = []
            for member, copy, covered in zip(film.members, copies, hidden, strict=True):
                for single in copy[:, c, frame]:
                    row = np.where(covered[frame][:, None], np.nan, single)
                    if np.isfinite(row[:, 0]).sum() >= FEWEST:
                        rows.append((member.number, row))
            order = rng.permutation(len(rows))
            frames_points.append(np.array([rows[k][1] for k in order]).reshape(-1, len(MARKERS), 3))
            frames_numbers.append(np.array([rows[k][0] for k in order], int))
        points.append(frames_points)
        numbers.append(frames_numbers)
    return Detections(points, numbers)


def _detected(member, cameras, network, seed):
    """The detections of one person as if nobody else was there, (2, camera, frame, 15, 3): the second ones are doubles, NaN where there are none."""
    rng = np.random.default_rng((seed, member.number, 2))
    seen = seen_by(network.keypoints._replace(seed=1000 * seed + member.number), cameras, member.person.markers)
    exchanged = [MARKERS.index(_mirrored(name)) for name in MARKERS]
    share = rng.random((3, *seen.shape[:2]))
    seen = np.where((share[0] < network.swapped)[..., None, None], seen[:, :, exchanged], seen)
    is_seen = (share[1] >= network.missed) & member.present
    if member.cameras:
        is_seen &= np.array([camera.name in member.cameras for camera in cameras])[:, None]
    double = seen + rng.normal(0, 2.0, seen.shape) * (1, 1, 0)
    double[..., 2] *= 0.8
    double = np.where((rng.random(seen.shape[:3]) < 0.15)[..., None], np.nan, double)
    return np.stack(
        [np.where(there[..., None, None], rows, np.nan) for there, rows in ((is_seen, seen), (is_seen & (share[2] < network.doubled), double))]
    )


def _hidden(camera, members):
    """Which markers of each person another one hides from a camera, (person, frame, 15)."""
    count = len(members[0].present)
    points = np.stack([member.person.markers for member in members])
    places = pixels(camera, points.reshape(-1, 3))[0].reshape(*points.shape[:-1], 2)
    depth = points @ camera.rotation[2] + camera.translation_m[2]
    hidden = np.zeros(points.shape[:-1], bool)
    for front, person in enumerate(members):
        if person.cameras:
            continue
        for upper, lower, radius in PARTS:
            i, j = MARKERS.index(upper), MARKERS.index(lower)
            start, along = places[front, :, i], places[front, :, j] - places[front, :, i]
            share = ((places - start[:, None]) * along[:, None]).sum(axis=-1) / np.maximum((along**2).sum(axis=-1), 1e-9)[:, None]
            share = np.clip(share, 0, 1)
            off = np.linalg.norm(places - start[:, None] - share[..., None] * along[:, None], axis=-1)
            near = depth[front, :, i, None] + share * (depth[front, :, j] - depth[front, :, i])[:, None]
            covers = (off < radius * camera.focal_px[0] / np.maximum(near, 0.1)) & (near < depth - BEHIND_M)
            covers[front] = False
            hidden |= covers & person.present[:count, None]
    return hidden


def write_project(folder, film, network=CrowdNetwork(), seed=0):
    """Write what `bayes-body import pose2sim FOLDER SESSION --up z --fps 60` reads: calibration, blank pictures and a network's files; and the truth.

    The truth of each person is in truth_person_N.npz, NaN in frames in which the person is not there.
    """
    folder, detections = Path(folder), detect(film, network, seed)
    write_calibration(folder / CALIBRATION, film.rig.cameras)
    for camera, points in zip(film.rig.cameras, detections.points, strict=True):
        place = folder / "pose" / f"{camera.name}_json"
        place.mkdir(parents=True)
        for frame, people in enumerate(points):
            write_detections(place, camera.name, frame, people)
        _write_blanks(folder / "videos" / camera.name, camera.size_px, len(points))
    for person in film.members:
        markers = np.where(person.present[:, None, None], person.person.markers, np.nan)
        np.savez(folder / f"truth_person_{person.number}.npz", markers=markers, names=np.array(MARKERS))
    return detections


def _write_blanks(folder, size_px, frames):
    """One picture under the names of all frames. An image with a single grey level would count as not seen."""
    folder.mkdir(parents=True)
    width, height = size_px
    cv2.imwrite(str(folder / "000000.png"), np.arange(width * height).astype(np.uint8).reshape(height, width))
    for frame in range(1, frames):
        os.link(folder / "000000.png", folder / f"{frame:06d}.png")
