"""Where the person stands, from the silhouette of a single camera: on the floor, and as tall as their stature says.

The ray through the silhouette's lowest point meets the floor (height 0) below the feet. The crown is where the vertical above that point comes
nearest to the ray through the silhouette's highest point. Nothing is told of limbs or facing. A shadow at the feet misplaces the person; the stature
shows that only if the height that follows is far from it. Pelvis, torso and head have the proportions of a person who stands.
"""

import cv2
import numpy as np
from jaxtyping import Float

from bayes_body.detection.detections import Detections, Found, Person, every_facing, landmark
from bayes_body.detection.figure import HIP, SHOULDER
from bayes_body.detection.hull import Mask
from bayes_body.detection.pairs import rays
from bayes_body.detection.scene import Scene
from bayes_body.detection.silhouettes import HEAD, PELVIS

NAME = "standing"
# Standard deviations of the place on the floor and of heights.
SD_LEVEL_M, SD_HEIGHT_M = 0.5, 0.12
# Directions in which the person may face, and the standard deviation of a part's tilt, radians.
DIRECTIONS, SD_TILT_RAD = 8, 0.25
# Middles of the parts, shares of the height.
MIDDLES = {"pelvis": HIP + PELVIS / 2, "torso": (HIP + SHOULDER) / 2, "head": 1 - HEAD / 2}
# A person's height in the image must agree with the stature within these ratios.
AGREES = (0.85, 1.08)
LEAST_M, MOST_M = 0.8, 2.3


def detect_standing(scene: Scene) -> Found:
    """Broad detections of the trunk and the head from one camera's silhouette; nothing where the person does not stand on the floor."""
    if scene.masks is None or len(scene.masks) != 1:
        return Found({}, {})
    mask = scene.masks[0]
    if not mask.any():
        return Found({}, {}, ("no silhouette in the only camera",))
    below, above = _ends(scene, _largest(mask))
    found = _floor_and_height(scene, below, above)
    if found is None:
        return Found({}, {}, ("the only camera does not show where the person stands: its silhouette does not reach the floor",))
    floor, height = found
    low, high = (AGREES[0] * scene.stature_m, AGREES[1] * scene.stature_m) if scene.stature_m else (LEAST_M, MOST_M)
    if not low <= height <= high:
        return Found({}, {}, (f"the only camera shows a person of {height:.2f} m on the floor; expected {low:.2f} to {high:.2f} m",))
    notice = "one camera: the person's place is uncertain, a shadow at the feet misplaces it; limbs and facing are unknown"
    landmarks = {name: _at(floor, share * height, scene) for name, share in (("pelvis", HIP), ("thorax", SHOULDER), ("head", 1.0))}
    return Found(landmarks, _parts(floor, height, scene), (notice,), Person(floor, height, None, False))


def _parts(floor: Float[np.ndarray, "3"], height: float, scene: Scene) -> dict[str, Detections]:
    """Pelvis, torso and head, once for each facing."""
    angles = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    facings = np.insert(np.stack([np.cos(angles), np.sin(angles)], axis=1), scene.up, 0.0, axis=1)
    # Across and along the part's axis, which points up.
    sd_m, up = np.array([SD_LEVEL_M, SD_LEVEL_M, SD_HEIGHT_M]), scene.upwards
    return {
        name: every_facing(floor + share * height * up, up, facings, sd_m, SD_TILT_RAD, np.ones(DIRECTIONS), NAME) for name, share in MIDDLES.items()
    }


def _at(floor: Float[np.ndarray, "3"], height: float, scene: Scene) -> Detections:
    sd = np.full(3, SD_LEVEL_M)
    sd[scene.up] = SD_HEIGHT_M
    return landmark((floor + height * scene.upwards)[None], sd, np.ones(1), NAME)


def _largest(mask: Mask) -> Mask:
    """The mask's largest connected part."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    return np.asarray(labels == 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax()))


def _ends(scene: Scene, mask: Mask) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """The directions of a silhouette's lowest and highest ray."""
    rows, columns = np.nonzero(mask)
    directions = rays(scene.cameras[0], np.stack([columns, rows], axis=1).astype(float))
    slopes = directions[:, scene.up] / np.maximum(np.linalg.norm(np.delete(directions, scene.up, axis=1), axis=1), 1e-6)
    return directions[int(slopes.argmin())], directions[int(slopes.argmax())]


def _floor_and_height(scene: Scene, below: Float[np.ndarray, "3"], above: Float[np.ndarray, "3"]) -> tuple[Float[np.ndarray, "3"], float] | None:
    """The point of the floor under the person, and the crown's height; None if the lowest ray does not meet the floor."""
    start = scene.viewpoints[0]
    if below[scene.up] * start[scene.up] >= 0:
        return None
    floor = start - start[scene.up] / below[scene.up] * below
    level = np.delete(above, scene.up)
    away = np.delete(floor - start, scene.up)
    reach = (away @ level) / max(float(level @ level), 1e-9)
    return floor, float(start[scene.up] + reach * above[scene.up])
