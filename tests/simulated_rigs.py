"""Rigs around a room, what keypoint networks see of a person in them, and their calibrations as programs write them."""

import json
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from bayes_body.recording.readers.keypoints.openpose import LAYOUTS
from bayes_body.recording.readers.keypoints.triangulate import project
from bayes_body.recording.session.session import CameraSpec

NAMES = LAYOUTS["COCO_17"]
LANDSCAPE, PORTRAIT = (1280, 720), (720, 1280)


def rig(count, size=LANDSCAPE, seed=0) -> list[CameraSpec]:
    """Cameras around a room, at different heights and distances, with tilted lenses."""
    rng, cameras = np.random.default_rng(seed), []
    for azimuth in 2 * np.pi * np.arange(count) / count + rng.uniform(-0.3, 0.3, count):
        centre = np.array([np.cos(azimuth), np.sin(azimuth), 0.0]) * rng.uniform(3.5, 5.0) + [0, 0, rng.uniform(0.8, 2.4)]
        forward = np.array([*rng.uniform(-0.2, 0.2, 2), 1.0]) - centre
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        R = np.stack([right, np.cross(forward, right), forward])
        lens = (*rng.uniform(-0.1, 0.05, 2).tolist(), *rng.uniform(-1e-3, 1e-3, 2).tolist(), 0.0)
        middle = tuple(side / 2 + float(rng.uniform(-15, 15)) for side in size)
        cameras.append(CameraSpec(f"c{len(cameras)}", size, (1000.0, 1004.0), middle, 0.0, lens, R, -R @ centre))
    return cameras


def walk(frames, height_m=1.75) -> np.ndarray:
    """A person who walks along x, (frame, keypoint, 3) in COCO_17, metres: trunk and head, and arms and legs that swing."""
    points = {"nose": (0.07, 0.0, 0.92), "l_eye": (0.055, 0.018, 0.935), "l_ear": (0.01, 0.042, 0.925)}
    points |= {"l_shoulder": (0.0, 0.105, 0.82), "l_hip": (0.0, 0.055, 0.535)}
    points |= {name.replace("l_", "r_", 1): (x, -y, z) for name, (x, y, z) in points.items() if name.startswith("l_")}
    phase = 0.7 * np.arange(frames) + 0.4
    places = {name: np.tile(place, (frames, 1)) for name, place in points.items()}
    for side, sign in {"l": 1.0, "r": -1.0}.items():
        # Length as a share of the stature, mean angle and swing from the vertical.
        for upper, lower, length, mean, swing in (
            ("shoulder", "elbow", 0.17, 0.0, -0.4),
            ("elbow", "wrist", 0.148, 0.4, -0.4),
            ("hip", "knee", 0.245, 0.1, 0.45),
            ("knee", "ankle", 0.246, -0.35, 0.3),
        ):
            angle = mean + sign * swing * np.sin(phase)
            places[f"{side}_{lower}"] = places[f"{side}_{upper}"] + length * np.stack([np.sin(angle), 0.0 * angle, -np.cos(angle)], axis=-1)
    steps = np.stack([0.04 * np.arange(frames) - 0.3, np.zeros(frames), np.zeros(frames)], axis=-1)
    return height_m * np.stack([places[name] for name in NAMES], axis=1) + steps[:, None]


def crowd(cameras, frames=5, noise_px=3.0, seed=0, places=None):
    """The people of each frame and camera: one who walks, as `places` has it, or by default points of no symmetry that move."""
    rng = np.random.default_rng(seed)
    body = rng.uniform([-0.3, -0.3, 0.0], [0.3, 0.3, 1.75], (len(NAMES), 3))
    if places is None:
        places = [body + np.array([0.1 * frame - 0.2, 0.05 * frame, 0.0]) for frame in range(frames)]
    people = []
    for points in places:
        seen = [project(camera, points) + rng.normal(0, noise_px, (len(NAMES), 2)) for camera in cameras]
        people.append([np.column_stack([pixels, np.full(len(NAMES), 0.9)])[None] for pixels in seen])
    return people


def write_recording(folder: Path, cameras, people) -> Path:
    """Write pictures (CAMERA/0000.png), and keypoints in COCO_17 (pose/CAMERA_json)."""
    for c, camera in enumerate(cameras):
        pictures, keypoints = folder / camera.name, folder / "pose" / f"{camera.name}_json"
        pictures.mkdir(parents=True)
        keypoints.mkdir(parents=True)
        for frame, groups in enumerate(people):
            cv2.imwrite(str(pictures / f"{frame:04d}.png"), np.full(camera.size_px[::-1], 100 + frame, np.uint8))
            persons = [{"pose_keypoints_2d": person.ravel().tolist()} for person in groups[c]]
            (keypoints / f"{camera.name}.{frame:04d}.json").write_text(json.dumps({"people": persons}))
    return folder


def matrix_of(camera) -> np.ndarray:
    (fx, fy), (cx, cy) = camera.focal_px, camera.centre_px
    return np.array([[fx, fx * camera.skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def write_toml(path: Path, cameras, more="", nested=False) -> Path:
    """Pose2Sim's tables, or Caliscope's with rotation matrices below [cameras]; `more` is written into each."""
    lines = []
    for c, camera in enumerate(cameras):
        rotation = camera.rotation if nested else cv2.Rodrigues(camera.rotation)[0].ravel()
        lines += [f"[cameras.{c}]" if nested else f"[{camera.name}]", f'name = "{camera.name}"', f"size = {list(camera.size_px)}"]
        lines += [f"matrix = {matrix_of(camera).tolist()}", f"distortions = {list(camera.distortion)}", f"rotation = {rotation.tolist()}"]
        lines += [f"translation = {camera.translation_m.tolist()}", more, ""]
    path.write_text("\n".join(lines))
    return path


def write_qualisys(path: Path, cameras) -> Path:
    """Qualisys's file: pixels times 64, millimetres, the view along -z."""
    lines = ["<?xml version='1.0' encoding='ASCII'?>", "<calibration><cameras>"]
    for camera in cameras:
        (fx, fy), (cx, cy), (k1, k2, p1, p2, k3) = 64 * np.array(camera.focal_px), 64 * np.array(camera.centre_px), camera.distortion
        turn = (np.diag([1.0, -1.0, -1.0]) @ camera.rotation).tolist()
        entries = " ".join(f'r{row + 1}{column + 1}="{turn[row][column]}"' for row in range(3) for column in range(3))
        x, y, z = (-1000 * camera.rotation.T @ camera.translation_m).tolist()
        width, height = camera.size_px
        lines += [
            f'<camera serial="{camera.name}" model="Miqus Video" viewrotation="0">',
            f'<fov_video left="0" top="0" right="{width - 1}" bottom="{height - 1}"/>',
            f'<transform {entries} x="{x}" y="{y}" z="{z}"/>',
            f'<intrinsic focalLengthU="{fx}" focalLengthV="{fy}" centerPointU="{cx}" centerPointV="{cy}" skew="0.0"',
            f' radialDistortion1="{k1}" radialDistortion2="{k2}" radialDistortion3="{k3}"',
            f' tangentalDistortion1="{p1}" tangentalDistortion2="{p2}"/></camera>',
        ]
    path.write_text("\n".join([*lines, "</cameras></calibration>"]))
    return path


def write_vicon(path: Path, cameras) -> Path:
    """Vicon's file: the camera's centre in millimetres, a quaternion, no tangential distortion."""
    lines = ["<?xml version='1.0'?><Cameras VERSION='1.2'>"]
    for camera in cameras:
        x, y, z, w = Rotation.from_matrix(camera.rotation).as_quat().tolist()
        place = " ".join(map(repr, (-1000 * camera.rotation.T @ camera.translation_m).tolist()))
        (fx, fy), (cx, cy), (k1, k2, _, _, k3) = camera.focal_px, camera.centre_px, camera.distortion
        lines.append(
            f'<Camera DEVICEID="{camera.name}" TYPE="Vue" SYSTEM="DV" SENSOR_SIZE="{camera.size_px[0]} {camera.size_px[1]}" '
            f'PIXEL_ASPECT_RATIO="{fx / fy!r}"><KeyFrames><KeyFrame FRAME="0" FOCAL_LENGTH="{fx}" PRINCIPAL_POINT="{cx} {cy}" '
            f'ORIENTATION="{x} {y} {z} {w}" POSITION="{place}" VICON_RADIAL2="ViconRadial2 {cx} {cy} {k1} {k2} {k3}"/></KeyFrames></Camera>'
        )
    path.write_text("\n".join([*lines, "</Cameras>"]))
    return path
