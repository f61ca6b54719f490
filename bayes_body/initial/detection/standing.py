"""Where the person stands, from the silhouette of a single camera: on the floor, and as tall as their stature says.

The ray through the silhouette's lowest point, turned to the middle of its upper half, meets the floor (height 0) below the pelvis. The crown is
where the vertical above that point comes nearest to the ray through the silhouette's highest point. Limbs and facing stay unknown. A shadow at the
feet misplaces the person along the line of sight; this is noticed only if the resulting height is far from the stature. Pelvis, torso and head have
the proportions of a person who stands. Of several silhouettes, the largest one that stands on the floor is the person's.
"""

from collections.abc import Iterator

import cv2
import numpy as np
from jaxtyping import Float

from bayes_body.initial.detection.detections import Detections, Found, Person, every_facing, landmark
from bayes_body.initial.detection.figure import HIP, SHOULDER
from bayes_body.initial.detection.hull import Mask, rays
from bayes_body.initial.detection.scene import Scene
from bayes_body.initial.detection.silhouettes import HEAD, PELVIS

NAME = "standing"
# Standard deviations of the place on the floor along the line of sight and across it, and of heights.
SD_DEPTH_M, SD_ACROSS_M, SD_HEIGHT_M = 0.5, 0.15, 0.12
# The standard deviation of a part's tilt, radians.
SD_TILT_RAD = 0.25
# Middles of the parts, shares of the height.
MIDDLES = {"pelvis": HIP + PELVIS / 2, "torso": (HIP + SHOULDER) / 2, "head": 1 - HEAD / 2}
# A person's height in the image must agree with the stature within these ratios.
AGREES = (0.85, 1.08)
LEAST_M, MOST_M = 0.8, 2.3
# Silhouettes with less than this share of the largest one's area are not people.
LEAST_SHARE = 0.3


def detect_standing(scene: Scene) -> Found:
    """Return broad detections of the trunk and the head from one camera's silhouette; none if the person does not stand on the floor."""
    if scene.masks is None or len(scene.masks) != 1:
        return Found({}, {})
    mask = scene.masks[0]
    if not mask.any():
        return Found({}, {}, ("no silhouette in the only camera",))
    low, high = (AGREES[0] * scene.stature_m, AGREES[1] * scene.stature_m) if scene.stature_m else (LEAST_M, MOST_M)
    standing = [_floor_and_height(scene, silhouette) for silhouette in _silhouettes(mask)]
    if all(stance is None for stance in standing):
        return Found({}, {}, ("the only camera does not show where the person stands: its silhouette does not reach the floor",))
    people = [stance for stance in standing if stance is not None and low <= stance[1] <= high]
    if not people:
        height = next(stance[1] for stance in standing if stance is not None)
        return Found({}, {}, (f"the only camera shows a person of {height:.2f} m on the floor; expected {low:.2f} to {high:.2f} m",))
    floor, height = people[0]
    notices = ["one camera: the person's place is uncertain, a shadow at the feet misplaces it; limbs and facing are unknown"]
    if len(standing) > 1:
        notices.append(f"{len(standing)} silhouettes of a person's size: the largest one that stands on the floor was taken")
    landmarks = {name: _landmark_at(floor, share * height, scene) for name, share in (("pelvis", HIP), ("thorax", SHOULDER), ("head", 1.0))}
    return Found(landmarks, _parts(floor, height, scene), tuple(notices), Person(floor, height, None, False))


def _parts(floor: Float[np.ndarray, "3"], height: float, scene: Scene) -> dict[str, Detections]:
    """Return detections of pelvis, torso and head that face away from the camera, towards it, and to both sides."""
    up, view_direction = scene.upwards, _view_direction(floor, scene)
    sideways = np.cross(up, view_direction)
    # Along a part's axes: forward, left, and up.
    level = np.array([[SD_DEPTH_M, SD_ACROSS_M], [SD_ACROSS_M, SD_DEPTH_M]])[[0, 0, 1, 1]]
    sd_m = np.concatenate([level, np.full((4, 1), SD_HEIGHT_M)], axis=1)
    facings = np.stack([view_direction, -view_direction, sideways, -sideways])
    return {name: every_facing(floor + share * height * up, up, facings, sd_m, SD_TILT_RAD, np.ones(4), NAME) for name, share in MIDDLES.items()}


def _view_direction(floor: Float[np.ndarray, "3"], scene: Scene) -> Float[np.ndarray, "3"]:
    """Return the horizontal direction from the camera to the person."""
    view_direction = (floor - scene.viewpoints[0]) * (1 - scene.upwards)
    return view_direction / np.linalg.norm(view_direction)


def _landmark_at(floor: Float[np.ndarray, "3"], height: float, scene: Scene) -> Detections:
    # A landmark's standard deviations are along the world's axes.
    view_direction = _view_direction(floor, scene)
    sd = np.hypot(SD_DEPTH_M * view_direction, SD_ACROSS_M * np.cross(scene.upwards, view_direction)) + SD_HEIGHT_M * scene.upwards
    return landmark((floor + height * scene.upwards)[None], sd, np.ones(1), NAME)


def _silhouettes(mask: Mask) -> Iterator[Mask]:
    """Yield the mask's connected parts of a person's size, the largest one first."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    areas = stats[1:, cv2.CC_STAT_AREA]
    for number in np.argsort(-areas, kind="stable"):
        if areas[number] >= LEAST_SHARE * areas.max():
            yield np.asarray(labels == 1 + number)


def _floor_and_height(scene: Scene, mask: Mask) -> tuple[Float[np.ndarray, "3"], float] | None:
    """Return the point of the floor under a silhouette's person, and the crown's height; None if the lowest ray does not meet the floor."""
    rows, columns = np.nonzero(mask)
    directions = rays(scene.cameras[0], np.stack([columns, rows], axis=1).astype(float))
    lengths = np.maximum(np.linalg.norm(directions * (1 - scene.upwards), axis=1), 1e-6)
    slopes = directions[:, scene.up] / lengths
    # All rays are turned to the middle of the upper half, where no shadow is and no leg stands out.
    level = directions[slopes >= (slopes.min() + slopes.max()) / 2].mean(axis=0) * (1 - scene.upwards)
    start = scene.viewpoints[0]
    if slopes.min() * start[scene.up] >= 0 or not level.any():
        return None
    distance = -start[scene.up] / slopes.min()
    floor = start * (1 - scene.upwards) + distance * level / np.linalg.norm(level)
    return floor, float(start[scene.up] + distance * slopes.max())
