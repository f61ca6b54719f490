r"""The head, from faces in several views (Viola & Jones 2001; Sigal, Isard, Haussecker & Black 2011, 6.1).

OpenCV's cascades for frontal faces and profiles search each view, turned so that the world's up is up in the picture, with the profiles in both
mirror images. Faces of two views are paired: the rays through their middles must meet, at a place where both have the size of a head. A face in a
single view is paired with the head of the visual hull, if its ray passes that. A frontal face looks to its camera, a profile aside; a pair looks
where both look on average. Heads outside the foreground are dropped.
"""

from collections.abc import Iterator, Sequence
from functools import lru_cache
from itertools import combinations
from pathlib import Path
from threading import Lock
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from bayes_body.initial.detection.detections import Found, axis_frames, landmark, part
from bayes_body.initial.detection.pairs import rays, triangulate_pair
from bayes_body.initial.detection.scene import Scene
from bayes_body.initial.detection.upright import Upright, upright

NAME = "faces"
# Cascade, whether the picture is mirrored, and where the face looks in the upright picture itself: 0 to the camera, 1 to the right, -1 to the left.
CASCADES = (
    ("haarcascade_frontalface_alt2.xml", False, 0),
    ("haarcascade_frontalface_default.xml", False, 0),
    ("haarcascade_profileface.xml", False, -1),
    ("haarcascade_profileface.xml", True, 1),
)
# Angle between a profile and the camera: the cascade finds faces that look aside by 30 to 90 degrees.
PROFILE_RAD = np.pi / 3
# Side of a face's box: accepted range, metres; OpenCV's boxes reach from the brows to the chin.
SIZES_M = (0.12, 0.35)
STEP, NEIGHBOURS = 1.1, 3
# Rays that pair may miss each other by this share of the face's side; a ray may miss the hull's head by this, metres.
MISS, MISS_HULL_M = 0.35, 0.15
# The face's middle lies in front of the skull's; the crown above. Metres.
FRONT_M, CROWN_M = 0.05, 0.11
SD_M, SD_RAD = 0.05, (0.3, 0.3, np.pi / 4 / np.sqrt(3))
# Weight of a face in a single view, against a pair's; share of the views in which a head's middle is foreground.
SINGLE, FOREGROUND = 0.3, 0.6

_lock = Lock()


class Face(NamedTuple):
    """A face in one view: its middle (column, row), its box's side in pixels, and where it looks (`CASCADES`)."""

    view: int
    middle: Float[np.ndarray, "2"]
    side_px: float
    looks: int


class Head(NamedTuple):
    """A head in the world: the face's middle (metres), the horizontal direction to which it looks, and its weight."""

    middle: Float[np.ndarray, "3"]
    looks: Float[np.ndarray, "3"]
    weight: float


def detect_faces(scene: Scene) -> Found:
    """Detections of the head, and of the crown."""
    faces = [face for view in range(len(scene.cameras)) for face in _faces(scene, view)]
    if not faces:
        return Found({}, {}, ("no face was found in any view",))
    heads = [head for head in (*_pairs(scene, faces), *_singles(scene, faces)) if _is_foreground(scene, head.middle)]
    if not heads:
        return Found({}, {}, (f"{len(faces)} faces were found in the views, but no two of them are one head",))
    middles, looks = np.array([head.middle for head in heads]), np.array([head.looks for head in heads])
    weights = np.array([head.weight for head in heads])
    skulls = middles - FRONT_M * looks
    rotations = axis_frames(np.tile(scene.upwards, (len(heads), 1)), looks)
    crown = landmark(skulls + CROWN_M * scene.upwards, SD_M, weights, NAME)
    return Found({"head": crown}, {"head": part(skulls, rotations, SD_M, np.array(SD_RAD), weights, NAME)})


def _faces(scene: Scene, view: int) -> Iterator[Face]:
    turned = upright(scene, view)
    grey = cv2.equalizeHist(cv2.cvtColor(turned.picture, cv2.COLOR_BGR2GRAY))
    for name, mirrored, looks in CASCADES:
        for left, top, side in boxes(grey[:, ::-1] if mirrored else grey, name, turned):
            middle = np.array([left + (side - 1) / 2, top + (side - 1) / 2])
            if mirrored:
                middle[0] = grey.shape[1] - 1 - middle[0]
            yield Face(view, turned.to_image(middle), side / turned.scale, looks)


def boxes(grey: UInt8[np.ndarray, "row column"], cascade: str, turned: Upright) -> list[tuple[int, int, int]]:
    """(left, top, side) of the faces in a picture; where the picture's scale is known, only of faces of a possible size."""
    sides = [max(20, round(size * turned.pixels_per_m)) for size in SIZES_M] if turned.pixels_per_m else [20, max(grey.shape)]
    with _lock:
        rectangles = _cascade(cascade).detectMultiScale(
            np.ascontiguousarray(grey), STEP, NEIGHBOURS, minSize=(sides[0],) * 2, maxSize=(sides[1],) * 2
        )
    return [(int(left), int(top), int(side)) for left, top, side, _ in rectangles]


@lru_cache
def _cascade(name: str) -> cv2.CascadeClassifier:
    return cv2.CascadeClassifier(str(Path(cv2.__file__).parent / "data" / name))


def _pairs(scene: Scene, faces: Sequence[Face]) -> Iterator[Head]:
    for a, b in combinations(faces, 2):
        if a.view == b.view:
            continue
        middle, errors = triangulate_pair([scene.cameras[a.view], scene.cameras[b.view]], a.middle[None], b.middle[None])
        if not np.isfinite(middle).all() or errors[0] > MISS * min(a.side_px, b.side_px):
            continue
        looks = [_looks(scene, face, middle[0]) for face in (a, b)]
        both = looks[0] + looks[1]
        # Faces that look apart by more than 120 degrees are not one head.
        if np.linalg.norm(both) > 1 and all(_has_size(scene, face, middle[0]) for face in (a, b)):
            yield Head(middle[0], both / np.linalg.norm(both), 1.0)


def _singles(scene: Scene, faces: Sequence[Face]) -> Iterator[Head]:
    if scene.figure is None:
        return
    skull = scene.figure.crown - CROWN_M * scene.upwards
    for face in faces:
        ray = rays(scene.cameras[face.view], face.middle[None])[0]
        start = scene.viewpoints[face.view]
        nearest = start + ((skull - start) @ ray) * ray
        if np.linalg.norm(nearest - skull) < MISS_HULL_M and _has_size(scene, face, nearest):
            looks = _looks(scene, face, nearest)
            yield Head(nearest + FRONT_M * looks, looks, SINGLE)


def _has_size(scene: Scene, face: Face, place: Float[np.ndarray, "3"]) -> bool:
    distance = np.linalg.norm(place - scene.viewpoints[face.view])
    return bool(SIZES_M[0] <= face.side_px * distance / max(scene.cameras[face.view].focal_px) <= SIZES_M[1])


def _looks(scene: Scene, face: Face, place: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """The horizontal direction to which a face at a place looks."""
    view_direction = place - scene.viewpoints[face.view]
    view_direction = view_direction - (view_direction @ scene.upwards) * scene.upwards
    view_direction = view_direction / max(float(np.linalg.norm(view_direction)), 1e-6)
    angle = face.looks * PROFILE_RAD
    return -np.cos(angle) * view_direction + np.sin(angle) * np.cross(view_direction, scene.upwards)


def _is_foreground(scene: Scene, place: Float[np.ndarray, "3"]) -> bool:
    shares = scene.foreground(place[None])[0]
    return not np.isfinite(shares) or bool(shares >= FOREGROUND)
