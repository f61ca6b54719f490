r"""The head, from faces in several views (Viola & Jones 2001; Sigal, Isard, Haussecker & Black 2011, 6.1).

OpenCV's cascades for frontal faces and profiles search a picture of each view. The picture is turned so that the world's up is up, and cut out around
the head if its place is known. Profiles are also searched in the mirror image. Faces of two views are paired: the rays through their middles must
meet, at a place where both have the size of a head. A face in a single view is paired with the head of the visual hull if its ray passes near it. A
frontal face looks to its camera, a profile to the side; a pair looks in the mean direction of its faces. Heads outside the foreground are dropped.
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
from bayes_body.initial.detection.hull import rays, triangulate_pair
from bayes_body.initial.detection.scene import Scene
from bayes_body.recording.observation.pictures import Colours
from bayes_body.recording.readers.keypoints.triangulate import project

# The picture around a known head: its side in metres, and pixels a metre (a face is then about 50 pixels wide).
SIDE_M, PIXELS_PER_M = 0.5, 280.0
# Without a known head: the distance at which the direction of up is taken, metres, and the largest side of the picture.
AHEAD_M, SIDE_PX = 3.0, 900


class Upright(NamedTuple):
    """A turned picture.

    Attributes:
        picture: blue, green and red.
        matrix: maps (column, row, 1) of the picture to column and row of the camera's image.
        scale: the picture's pixels for one pixel of the image.
        pixels_per_m: the picture's pixels for a metre at the head; None if the head is not known.
    """

    picture: Colours
    matrix: Float[np.ndarray, "2 3"]
    scale: float
    pixels_per_m: float | None

    def to_image(self, pixel: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
        """Return the position of a pixel of the picture in the camera's image."""
        return self.matrix @ np.append(pixel, 1.0)


def upright(scene: Scene, view: int) -> Upright:
    """Return the turned picture of a view, cut out around the head of the visual hull if there is one."""
    camera = scene.cameras[view]
    if scene.figure is None:
        place = scene.viewpoints[view] + AHEAD_M * camera.rotation[2]
        size = np.array(camera.size_px, float)
        side = float(np.hypot(*size))
        scale = min(2.0, SIDE_PX / side)
        return _turned(scene, view, place, (size - 1) / 2, scale, round(side * scale), None)
    place = scene.figure.crown - 0.1 * scene.upwards
    metre = max(camera.focal_px) / float(np.linalg.norm(place - scene.viewpoints[view]))
    return _turned(scene, view, place, project(camera, place[None])[0], PIXELS_PER_M / metre, round(SIDE_M * PIXELS_PER_M), PIXELS_PER_M)


def _turned(
    scene: Scene, view: int, place: Float[np.ndarray, "3"], middle: Float[np.ndarray, "2"], scale: float, side: int, pixels_per_m: float | None
) -> Upright:
    low, high = project(scene.cameras[view], np.stack([place, place + 0.1 * scene.upwards]))
    down = low - high
    length = float(np.linalg.norm(down))
    # If the camera looks straight down or up, or the head is behind it, nothing is turned.
    down = down / length if np.isfinite(length) and length > 1e-6 else np.array([0.0, 1.0])
    middle = np.where(np.isfinite(middle), middle, 0.0)
    # The picture's columns run to the right of down, its rows along down.
    axes = np.column_stack([[down[1], -down[0]], down]) / scale
    matrix = np.column_stack([axes, middle - axes @ np.full(2, (side - 1) / 2)])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    picture = cv2.warpAffine(scene.pictures[view], matrix, (side, side), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return Upright(np.asarray(picture, np.uint8), matrix, scale, pixels_per_m)


NAME = "faces"
# Cascade, whether the picture is mirrored, and where the face looks in the upright picture itself: 0 to the camera, 1 to the right, -1 to the left.
CASCADES = (
    ("haarcascade_frontalface_alt2.xml", False, 0),
    ("haarcascade_frontalface_default.xml", False, 0),
    ("haarcascade_profileface.xml", False, -1),
    ("haarcascade_profileface.xml", True, 1),
)
# Angle between a profile and the camera: the cascade finds faces that are turned aside by 30 to 90 degrees.
PROFILE_RAD = np.pi / 3
# Side of a face's box: accepted range, metres; OpenCV's boxes reach from the brows to the chin.
SIZES_M = (0.12, 0.35)
STEP, NEIGHBOURS = 1.1, 3
# Rays that pair may miss each other by this share of the face's side; a ray may miss the hull's head by this, metres.
MISS, MISS_HULL_M = 0.35, 0.15
# The face's middle lies in front of the skull's; the crown above. Metres.
FRONT_M, CROWN_M = 0.05, 0.11
SD_M, SD_RAD = 0.05, (0.3, 0.3, np.pi / 4 / np.sqrt(3))
# Weight of a face in a single view, relative to a pair; least share of the views in which a head's middle is foreground.
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
    """Return detections of the head, and of the crown."""
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
        for first_column, top, side in boxes(grey[:, ::-1] if mirrored else grey, name, turned):
            middle = np.array([first_column + (side - 1) / 2, top + (side - 1) / 2])
            if mirrored:
                middle[0] = grey.shape[1] - 1 - middle[0]
            yield Face(view, turned.to_image(middle), side / turned.scale, looks)


def boxes(grey: UInt8[np.ndarray, "row column"], cascade: str, turned: Upright) -> list[tuple[int, int, int]]:
    """Return (left, top, side) of the faces in a picture; if the picture's scale is known, only faces of a possible size."""
    sides = [max(20, round(size * turned.pixels_per_m)) for size in SIZES_M] if turned.pixels_per_m else [20, max(grey.shape)]
    with _lock:
        rectangles = _cascade(cascade).detectMultiScale(
            np.ascontiguousarray(grey), STEP, NEIGHBOURS, minSize=(sides[0],) * 2, maxSize=(sides[1],) * 2
        )
    return [(int(first_column), int(top), int(side)) for first_column, top, side, _ in rectangles]


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
        direction = looks[0] + looks[1]
        # Faces whose directions differ by more than 120 degrees do not belong to one head.
        if np.linalg.norm(direction) > 1 and all(_has_size(scene, face, middle[0]) for face in (a, b)):
            yield Head(middle[0], direction / np.linalg.norm(direction), 1.0)


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
    """Return the horizontal direction in which a face at a place looks."""
    view_direction = place - scene.viewpoints[face.view]
    view_direction = view_direction - (view_direction @ scene.upwards) * scene.upwards
    view_direction = view_direction / max(float(np.linalg.norm(view_direction)), 1e-6)
    angle = face.looks * PROFILE_RAD
    return -np.cos(angle) * view_direction + np.sin(angle) * np.cross(view_direction, scene.upwards)


def _is_foreground(scene: Scene, place: Float[np.ndarray, "3"]) -> bool:
    shares = scene.foreground(place[None])[0]
    return not np.isfinite(shares) or bool(shares >= FOREGROUND)
