"""Detections of landmarks and parts from silhouettes alone: the person's figure in the visual hull, and the proportions of a body.

Pelvis, thorax and crown follow from the middle of the trunk. Shoulders and hips are proposed on circles around it, with more weight along the line
of the shoulders. Arms and legs follow from the paths between the hull's extremities and the pelvis: landmarks lie on a path at a limb's lengths from
its tip. An arm that touches the trunk has no extremity, and legs that touch share one path. Hanging arms are therefore also proposed around the trunk
inside the hull, and legs as the two halves of the hull's sections. This detector cannot tell left from right, or front from back.
"""

import numpy as np
from jaxtyping import Float
from scipy.cluster.vq import kmeans2
from scipy.spatial import KDTree

from bayes_body.initial.detection.detections import Detections, Found, Person, every_facing, landmark, merge, segments
from bayes_body.initial.detection.figure import SHOULDER, Figure
from bayes_body.initial.detection.hull import Voxels
from bayes_body.initial.detection.scene import Scene

NAME = "silhouettes"
# Fractions of the stature (Drillis & Contini 1966; those of hips and hands as in the bodies that ship).
HALF_HIPS, HALF_SHOULDERS, PELVIS, HEAD = 0.052, 0.1295, 0.084, 0.182
FOREARM, HAND, CALF, ANKLE, FOOT = 0.146, 0.095, 0.246, 0.039, 0.112
# A tip below this share of the height is a foot; a tip this near to the crown (share of the height) is the head.
FOOT_TIP, HEAD_TIP = 0.2, 0.16
# Hanging arms: distance from the trunk's middle and height below the shoulders, shares of the stature.
ELBOWS, WRISTS = ((0.145, 0.17),), ((0.16, 0.315), (0.22, 0.27))
# The crown is looked for above the hull if the hull ends farther than this below a known stature.
MISSING_M = 0.1
# Sections of legs, shares of the height: where knees and ankles are looked for.
KNEES, ANKLES = (0.25, 0.32), (0.02, 0.09)
# Directions on a circle around the trunk, and how far a proposed arm may be outside of the hull, metres.
DIRECTIONS, OUTSIDE_M = 8, 0.05
# Weight of a direction at the angle a to the chest's long axis: exp(ALONG cos 2a).
ALONG = 0.8
# Standard deviations, metres, set by hand: on simulated people of the training subjects, the error of the best detections on each axis is 0.5 to 0.9
# standard deviations.
SD_M = {"crown": 0.05, "trunk": 0.05, "shoulder": 0.07, "hip": 0.05, "leg": 0.06, "arm": 0.08}
# Share of the weight of landmarks that do not lie on a path.
GUESSED = 0.5

# Inner joint, outer joint and tip of a limb.
type Joints = tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"], Float[np.ndarray, "3"]]


def detect_silhouettes(scene: Scene) -> Found:
    """Return detections from the hull of two or more silhouettes."""
    if scene.figure is None or scene.chosen.voxels is None:
        return Found({}, {}, scene.chosen.notices)
    sketch = _Sketch(scene.figure, scene.chosen.voxels, scene.stature_m or scene.figure.height, scene.up)
    notices = scene.chosen.notices
    if len(scene.cameras) == 2:
        notices = (*notices, "two cameras: the visual hull is broad across the line between them")
    floor = scene.figure.pelvis.copy()
    floor[scene.up] = scene.figure.floor
    return Found({**sketch.trunk(), **sketch.legs(), **sketch.arms()}, sketch.parts(), notices, Person(floor, scene.figure.height, None, False))


class _Sketch:
    """The landmarks of a figure."""

    def __init__(self, figure: Figure, voxels: Voxels, stature: float, up: int):
        self.figure, self.voxels, self.stature, self.up = figure, voxels, stature, up
        self.upwards = np.eye(3)[up]
        angles = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
        forward = np.cross(figure.shoulder_axis, self.upwards)
        # Horizontal directions, the first along the chest's long axis; and their weights.
        self.circle = np.cos(angles)[:, None] * figure.shoulder_axis + np.sin(angles)[:, None] * forward
        self.circle_weights = np.exp(ALONG * np.cos(2 * angles))

    def trunk(self) -> dict[str, Detections]:
        """Return crown, pelvis, thorax, shoulders and hips."""
        figure, unit_weight = self.figure, np.ones(1)
        return {
            "head": self._crown(),
            "pelvis": landmark(figure.pelvis[None], SD_M["trunk"], unit_weight, NAME),
            "thorax": landmark(figure.thorax[None], SD_M["trunk"], unit_weight, NAME),
            **_left_and_right("shoulder", landmark(self._ring(figure.thorax, HALF_SHOULDERS, 0.0), SD_M["shoulder"], self.circle_weights, NAME)),
            **_left_and_right("hip", landmark(self._ring(figure.pelvis, HALF_HIPS, 0.0), SD_M["hip"], self.circle_weights, NAME)),
        }

    def _crown(self) -> Detections:
        """Return the hull's crown; also the place given by the stature, if the hull ends far below it."""
        figure = self.figure
        points, weights = figure.crown[None], np.ones(1)
        if figure.height - (figure.crown[self.up] - figure.floor) > MISSING_M:
            standing = figure.thorax + (1 - SHOULDER) * figure.height * self.upwards
            points, weights = np.stack([figure.crown, standing]), np.array([1 - GUESSED, GUESSED])
        return landmark(points, SD_M["crown"], weights, NAME)

    def legs(self) -> dict[str, Detections]:
        """Return knees and ankles."""
        knees, ankles, _ = self._on_paths(self._legs())
        return {
            **_left_and_right("ankle", _mixture(ankles, self._halves(ANKLES), SD_M["leg"])),
            **_left_and_right("knee", _mixture(knees, self._halves(KNEES), SD_M["leg"])),
        }

    def arms(self) -> dict[str, Detections]:
        """Return elbows and wrists."""
        elbows, wrists, _ = self._on_paths(self._arms())
        return {
            **_left_and_right("wrist", _mixture(wrists, self._hanging(WRISTS), SD_M["arm"])),
            **_left_and_right("elbow", _mixture(elbows, self._hanging(ELBOWS), SD_M["arm"])),
        }

    def limbs(self) -> dict[str, Detections]:
        """Return calves, feet, forearms and hands along the paths, where there are any."""
        mixtures = dict[str, Detections]()
        for inner, outer, joints, sd in (("calf", "foot", self._legs(), SD_M["leg"]), ("forearm", "hand", self._arms(), SD_M["arm"])):
            if joints:
                first, second, tips = self._on_paths(joints)
                mixtures |= _left_and_right(inner, segments(first, second, sd, np.ones(len(first)), NAME))
                mixtures |= _left_and_right(outer, segments(second, tips, sd, np.ones(len(second)), NAME))
        return {name: mixture for name, mixture in mixtures.items() if len(mixture.weights)}

    def _legs(self) -> list[Joints]:
        """Return knee, ankle and tip of each path that ends in a foot, for each of two places of the ankle."""
        paths = [path for path in self.figure.paths if self._height(path[:1])[0] < FOOT_TIP]
        return [(_beyond(path, ankle, CALF * self.stature), ankle, path[0]) for path in paths for ankle in self._ankles(path)]

    def _arms(self) -> list[Joints]:
        """Return elbow, wrist and tip of each path that ends neither in a foot nor in the head."""
        arms = list[Joints]()
        for path in self.figure.paths:
            is_head = np.linalg.norm(path[0] - self.figure.crown) < HEAD_TIP * self.figure.height
            if self._height(path[:1])[0] > FOOT_TIP + 0.1 and not is_head:
                wrist = _point_at(path, HAND * self.stature)
                arms.append((_beyond(path, wrist, FOREARM * self.stature), wrist, path[0]))
        return arms

    def _on_paths(self, joints: list[Joints]) -> Float[np.ndarray, "3 limb 3"]:
        """Return the joints of limbs as arrays: the inner ones, the outer ones, and the tips."""
        return np.array(joints, float).reshape(-1, 3, 3).transpose(1, 0, 2)

    def parts(self) -> dict[str, Detections]:
        """Return pelvis, torso and head, once for each facing; and limbs."""
        figure, up = self.figure, self.upwards
        navel = figure.pelvis + PELVIS * self.stature * up
        skull = figure.crown - HEAD / 2 * self.stature * up
        return {
            "pelvis": self._upright((figure.pelvis + navel) / 2, up, SD_M["trunk"], 0.2),
            "torso": self._upright((figure.pelvis + figure.thorax) / 2, figure.thorax - figure.pelvis, SD_M["trunk"], 0.2),
            "head": self._upright(skull, up, SD_M["crown"], 0.3),
            **self.limbs(),
        }

    def _upright(self, middle: np.ndarray, axis: np.ndarray, sd_m: float, sd_tilt_rad: float) -> Detections:
        return every_facing(middle, axis, np.cross(self.circle, self.upwards), sd_m, sd_tilt_rad, self.circle_weights, NAME)

    def _height(self, points: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, " point"]:
        """Return heights above the floor as shares of the person's height."""
        return (points[:, self.up] - self.figure.floor) / self.figure.height

    def _ring(self, middle: Float[np.ndarray, "3"], radius: float, below: float) -> Float[np.ndarray, "direction 3"]:
        return middle + self.stature * (radius * self.circle - below * self.upwards)

    def _hanging(self, places: tuple[tuple[float, float], ...]) -> Float[np.ndarray, "point 3"]:
        """Return points around the trunk that lie in the hull, or just outside of it."""
        points = np.concatenate([self._ring(self.figure.thorax, *place) for place in places])
        return points[KDTree(self.voxels).query(points)[0] < OUTSIDE_M]

    def _halves(self, between: tuple[float, float]) -> Float[np.ndarray, "half 3"]:
        """Return the middles of the two halves (2-means) of the hull between two heights."""
        heights = self._height(self.voxels)
        section = self.voxels[(heights > between[0]) & (heights < between[1])]
        if len(section) < 4:
            return np.zeros((0, 3))
        # The means start at the two ends of the longest axis, so that the result does not depend on chance.
        offsets = section - section.mean(axis=0)
        offsets[:, self.up] = 0
        lengthwise = offsets @ np.linalg.svd(offsets, full_matrices=False)[2][0]
        return kmeans2(section, section[[int(lengthwise.argmin()), int(lengthwise.argmax())]], minit="matrix")[0]

    def _ankles(self, path: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "2 3"]:
        """Return two places of the ankle: where the path has risen from the sole (flat foot), and a foot's length from the tip (lifted foot)."""
        heights = path[:, self.up]
        sole = heights[: max(2, len(path) // 3)].min()
        return np.stack([path[np.argmax(heights >= sole + 2 * ANKLE * self.stature)], _point_at(path, 0.9 * FOOT * self.stature)])


def _left_and_right(name: str, detections: Detections) -> dict[str, Detections]:
    return {"l_" + name: detections, "r_" + name: detections}


def _mixture(on_paths: Float[np.ndarray, "path 3"], guessed: Float[np.ndarray, "point 3"], sd_m: float) -> Detections:
    """Return landmarks on paths, and others with the share GUESSED of the weight."""
    groups = [(landmark(points, sd_m, np.ones(len(points)), NAME), share) for points, share in ((on_paths, 1 - GUESSED), (guessed, GUESSED))]
    return merge(groups) or landmark(np.zeros((0, 3)), sd_m, np.zeros(0), NAME)


def _point_at(path: Float[np.ndarray, "point 3"], length: float) -> Float[np.ndarray, "3"]:
    """Return the point of a path at this length from its tip."""
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    return np.array([np.interp(length, travelled, path[:, k]) for k in range(3)])


def _beyond(path: Float[np.ndarray, "point 3"], point: Float[np.ndarray, "3"], length: float) -> Float[np.ndarray, "3"]:
    """Return the first point of a path from its tip that is farther than `length` from a point near the tip; the path's end if there is none."""
    start = int(np.argmin(((path - point) ** 2).sum(axis=1)))
    is_beyond = np.linalg.norm(path[start:] - point, axis=1) >= length
    return path[start + int(np.argmax(is_beyond))] if is_beyond.any() else path[-1]
