"""Detections from keypoints of any network: triangulated landmarks, and the parts between them. Keypoints tell left from right, front from back."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from bayes_body.initial.detection.detections import LANDMARKS, UNKNOWN_RAD, Detections, Found, Person, axis_frames, landmark, part
from bayes_body.initial.detection.scene import Scene
from bayes_body.recording.readers.keypoints.triangulate import Triangulated, triangulate

NAME = "keypoints"
# The ends of each part, from proximal to distal.
_LIMBS = {
    "upper_arm": ("shoulder", "elbow"),
    "forearm": ("elbow", "wrist"),
    "thigh": ("hip", "knee"),
    "calf": ("knee", "ankle"),
    "foot": ("heel", "big_toe"),
}
ENDS = {side + name: (side + a, side + b) for side in ("l_", "r_") for name, (a, b) in _LIMBS.items()} | {"torso": ("pelvis", "thorax")}
# Landmarks that follow from two others if they are missing.
MIDDLES = {"pelvis": ("l_hip", "r_hip"), "thorax": ("l_shoulder", "r_shoulder")}
# Networks miss a joint's centre by at least this distance, metres; those of hips, shoulders and the crown by more.
LEAST_SD_M, LOOSE_SD_M = 0.02, 0.04
LOOSE = frozenset(("l_hip", "r_hip", "pelvis", "thorax", "head"))
# Standard deviations of a part's tilt, and of the trunk's facing, radians.
SD_TILT_RAD, SD_FACING_RAD = 0.15, 0.2
# The skull's middle lies this far behind the nose, and this far below the crown, metres.
BEHIND_NOSE_M, BELOW_CROWN_M = 0.10, 0.11

type Places = dict[str, tuple[Float[np.ndarray, "3"], float]]


def detect_keypoints(scene: Scene) -> Found:
    """Return detections from the subject's keypoints in two or more cameras."""
    views = [] if scene.keypoints is None else [keypoints for keypoints in scene.keypoints if keypoints]
    if scene.keypoints is None:
        return Found({}, {})
    if len(views) < 2:
        return Found({}, {}, ("fewer than two cameras have keypoints: they cannot be triangulated",))
    places = _places(scene)
    if not places:
        return Found({}, {}, ("no keypoint was found where two cameras agree",))
    landmarks = {name: landmark(place[None], sd, np.ones(1), NAME) for name, (place, sd) in places.items() if name in LANDMARKS}
    forward = _forward(places, scene.upwards)
    parts = {name: _limb(places, ends, forward) for name, ends in ENDS.items() if all(end in places for end in ends)}
    return Found(landmarks, {**parts, **_head(places, forward, scene.upwards)}, (), _person(places, forward, scene.up))


def _places(scene: Scene) -> Places:
    """Return the triangulated keypoints and their standard deviations, metres."""
    views = [keypoints or {} for keypoints in scene.keypoints or ()]
    names = sorted({name for keypoints in views for name in keypoints})
    observations = np.array([[keypoints.get(name, (np.nan, np.nan, 0.0)) for name in names] for keypoints in views], float)
    triangulation = triangulate(scene.cameras, observations.reshape(len(views), len(names), 3))
    sds = _sds(scene, triangulation)
    places = {name: (triangulation.points_m[k], _sd(name, sds[k])) for k, name in enumerate(names) if np.isfinite(triangulation.points_m[k]).all()}
    for name, (a, b) in MIDDLES.items():
        if name not in places and a in places and b in places:
            places[name] = (places[a][0] + places[b][0]) / 2, _sd(name, (places[a][1] + places[b][1]) / 2)
    return places


def _sds(scene: Scene, triangulation: Triangulated) -> Float[np.ndarray, " point"]:
    """Return the reprojection errors at the points' distances, metres."""
    metres = [
        np.linalg.norm(triangulation.points_m - viewpoint, axis=1) / max(camera.focal_px)
        for viewpoint, camera in zip(scene.viewpoints, scene.cameras, strict=True)
    ]
    counts = np.maximum(triangulation.used.sum(axis=0), 1)
    return triangulation.error_px * np.where(triangulation.used, np.stack(metres), 0.0).sum(axis=0) / counts


def _sd(name: str, sd: float) -> float:
    return float(np.hypot(sd, LOOSE_SD_M if name in LOOSE else LEAST_SD_M))


def _forward(places: Places, up: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"] | None:
    """Return the horizontal direction in which the trunk faces; None without both shoulders or both hips."""
    for name in ("shoulder", "hip"):
        if f"l_{name}" in places and f"r_{name}" in places:
            forward = np.cross(places[f"l_{name}"][0] - places[f"r_{name}"][0], up)
            if np.linalg.norm(forward) > 1e-3:
                return forward / np.linalg.norm(forward)
    return None


def _limb(places: Places, ends: tuple[str, str], forward: Float[np.ndarray, "3"] | None) -> Detections:
    """Return a part between two landmarks. Keypoints do not tell a limb's twist; the trunk's twist is that of the shoulders."""
    (a, sd_a), (b, sd_b) = (places[end] for end in ends)
    twist = SD_FACING_RAD if ends == ENDS["torso"] and forward is not None else UNKNOWN_RAD
    rotation = axis_frames((b - a)[None], (np.zeros(3) if forward is None else forward)[None])
    return part((a + b)[None] / 2, rotation, (sd_a + sd_b) / 2, np.array([SD_TILT_RAD, SD_TILT_RAD, twist]), np.ones(1), NAME)


def _head(places: Places, trunk: Float[np.ndarray, "3"] | None, up: Float[np.ndarray, "3"]) -> Mapping[str, Detections]:
    """Return detections of the head, from ears and nose or from the crown."""
    if all(name in places for name in ("l_ear", "r_ear", "nose")):
        ears = (places["l_ear"][0] + places["r_ear"][0]) / 2
        forward = places["nose"][0] - ears
        middle, sd_facing = ears, SD_FACING_RAD
    elif trunk is not None and ("nose" in places or "head" in places):
        forward, sd_facing = trunk, 2 * SD_FACING_RAD
        middle = places["nose"][0] - BEHIND_NOSE_M * trunk if "nose" in places else places["head"][0] - BELOW_CROWN_M * up
    else:
        return {}
    rotation = axis_frames(up[None], (forward - (forward @ up) * up)[None])
    return {"head": part(middle[None], rotation, LOOSE_SD_M, np.array([0.3, 0.3, sd_facing]), np.ones(1), NAME)}


def _person(places: Places, forward: Float[np.ndarray, "3"] | None, up: int) -> Person | None:
    """Return where the person stands; None without pelvis and ankles. Without the crown, the height is inferred from the height of the hips."""
    ankles = [places[name][0] for name in ("l_ankle", "r_ankle") if name in places]
    if "pelvis" not in places or not ankles:
        return None
    floor = places["pelvis"][0].copy()
    floor[up] = 0.0
    height = places["head"][0][up] if "head" in places else places["pelvis"][0][up] / 0.51
    return Person(floor, float(height), forward, forward is not None)
