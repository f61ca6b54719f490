"""People of spheres, drawn into the masks and pictures of calibrated cameras."""

import cv2
import numpy as np

from bayes_body.initial.detection.hull import clean
from bayes_body.initial.detection.scene import Scene
from bayes_body.recording.readers.keypoints.triangulate import project
from bayes_body.recording.session.session import CameraSpec

SIZE = (640, 480)
# Ends and radii (metres) of the parts of a person 1.75 m tall who faces +x, with the arms held aside; forearm and hand are one part.
PERSON = (
    ((0, 0, 0.95), (0, 0, 1.38), 0.13),
    ((0, 0, 1.45), (0, 0, 1.65), 0.10),
    ((0, 0.16, 1.40), (0, 0.42, 1.20), 0.05),
    ((0, 0.42, 1.20), (0, 0.74, 0.96), 0.04),
    ((0, -0.16, 1.40), (0, -0.42, 1.20), 0.05),
    ((0, -0.42, 1.20), (0, -0.74, 0.96), 0.04),
    ((0, 0.09, 0.93), (0.15, 0.12, 0.50), 0.07),
    ((0.15, 0.12, 0.50), (0.10, 0.13, 0.09), 0.05),
    ((0.10, 0.13, 0.05), (0.26, 0.14, 0.04), 0.04),
    ((0, -0.09, 0.93), (-0.1, -0.12, 0.50), 0.07),
    ((-0.1, -0.12, 0.50), (-0.25, -0.13, 0.09), 0.05),
    ((-0.25, -0.13, 0.05), (-0.10, -0.14, 0.04), 0.04),
)
JOINTS = {"l_ankle": (0.10, 0.13, 0.09), "r_ankle": (-0.25, -0.13, 0.09), "l_knee": (0.15, 0.12, 0.50), "r_knee": (-0.1, -0.12, 0.50)}
JOINTS |= {"l_elbow": (0, 0.42, 1.20), "r_elbow": (0, -0.42, 1.20), "l_wrist": (0, 0.62, 1.05), "head": (0, 0, 1.75), "thorax": (0, 0, 1.43)}


def camera(angle, name="c", distance=3.5, height=1.6, roll=0.0):
    """A camera on a circle around the origin that looks at (0, 0, 0.9), turned about its axis by `roll`."""
    place = np.array([distance * np.cos(angle), distance * np.sin(angle), height])
    ahead = np.array([0, 0, 0.9]) - place
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(ahead, right), ahead])
    c, s = np.cos(roll), np.sin(roll)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ R
    return CameraSpec(name, SIZE, (520.0, 520.0), (319.5, 239.5), 0.0, (-0.1, 0.03, 0.0, 0.0, 0.0), R, -R @ place)


def ring(count, **options):
    return [camera(2 * np.pi * (k + 0.2) / count, f"c{k}", **options) for k in range(count)]


def mask(spec, parts=PERSON, at=(0.0, 0.0), size=1.0):
    """The silhouette of a person who stands at a point of the floor."""
    drawn = np.zeros((SIZE[1], SIZE[0]), np.uint8)
    for first, last, radius in parts:
        steps = np.linspace(0, 1, 25)[:, None]
        places = size * (np.array(first) + steps * (np.array(last) - np.array(first))) + [*at, 0.0]
        depths = places @ spec.rotation[2] + spec.translation_m[2]
        for pixel, depth in zip(project(spec, places), depths, strict=True):
            cv2.circle(drawn, tuple(np.rint(pixel).astype(int).tolist()), max(1, round(520 * size * radius / depth)), 1, cv2.FILLED)
    return drawn > 0


def scene(cameras, masks, up=2, stature_m=None, keypoints=None, pictures=None):
    """A scene of silhouettes; by default its pictures are noise, which shows no face."""
    noise = np.random.default_rng(0).integers(90, 160, (SIZE[1], SIZE[0], 3), dtype=np.uint8)
    return Scene(cameras, pictures or [noise] * len(cameras), None if masks is None else [clean(each) for each in masks], keypoints, up, stature_m)
