"""Whether a rig is possible, told by its calibration alone: do its cameras see a common place, and are its lenses alike?

Each sentence names what is odd and what would explain it. Nothing is refused, since such cameras exist.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bayes_body.recording.readers.agreement.changes import CHANGES, POSES, SUBPIXELS
from bayes_body.recording.readers.keypoints.triangulate import project, undistorted_rays
from bayes_body.recording.readers.options import Axis
from bayes_body.recording.session.session import CameraSpec

# A common place is looked for at so many pixels of a side, and up to this distance: metres, or as a multiple of the rig's extent.
GRID = 9
FARTHEST_M, FARTHEST = 10.0, 1.5
DEPTHS = np.geomspace(0.01, 1.0, 40)
# Changes with which the cameras would see one.
MOST_LISTED = 2
# A principal point is odd if it is farther from the middle than this share of the diagonal, and explained if a change leaves this share of that.
CENTRAL, EXPLAINED = 0.08, 0.25
CENTRES = ("exchanged_centre", "half_size", "double_size")
# The focal lengths of a camera whose pixels are as square as those of the others differ by less.
SQUARE = 0.05
# Tangential distortion above this, and above so many times that of the others, is that of a failed calibration.
TANGENTIAL, TIMES = 0.01, 10.0
# Distortions (k1, k2, p1, p2) below these in every camera, and none of them 0, are no lens's: they have been divided.
DIVIDED = np.array([0.006, 0.01, 1e-4, 1e-4])


def describe_implausible(cameras: Sequence[CameraSpec], calibration: Path, up: Axis = "z") -> list[str]:
    """Return sentences on what is odd in a rig; none for a good one.

    Args:
        cameras: of the rig.
        calibration: its file or folder.
        up: the axis of the world that points up.
    """
    return [*_describe_centres(cameras), *_describe_lenses(cameras), *_describe_divided(cameras, calibration), *_describe_view(cameras, up)]


def _names(cameras: Sequence[CameraSpec]) -> str:
    return f"camera{'s' if len(cameras) > 1 else ''} {', '.join(repr(camera.name) for camera in cameras)}"


def _describe_centres(cameras: Sequence[CameraSpec]) -> list[str]:
    sentences = []
    for name in CENTRES:
        change = CHANGES[name]
        odd = [camera for camera in cameras if _offset(camera) > CENTRAL and _offset(change.for_pictures(camera)) < EXPLAINED * _offset(camera)]
        if odd:
            (column, row), (width, height) = odd[0].centre_px, odd[0].size_px
            place = f"the principal point is at ({column:.0f}, {row:.0f}) in pictures of {width} x {height}"
            option = f"--rig {name}" if len(odd) == len(cameras) else f"--rig {odd[0].name}={name}"
            sentences.append(f"{_names(odd)}: {place}, as if {change.meaning}: check the calibration; {option} would change it.")
    return sentences


def _offset(camera: CameraSpec) -> float:
    """Return the distance of the principal point from the middle of the pictures, as a share of the diagonal."""
    return float(np.hypot(*(np.array(camera.centre_px) - np.array(camera.size_px) / 2)) / np.hypot(*camera.size_px))


def _describe_lenses(cameras: Sequence[CameraSpec]) -> list[str]:
    sentences = []
    if len(cameras) < 2:
        return sentences
    ratios = [camera.focal_px[0] / camera.focal_px[1] for camera in cameras]
    tangential = [max(abs(camera.distortion[2]), abs(camera.distortion[3])) for camera in cameras]
    for c, camera in enumerate(cameras):
        usual = _usual(ratios, c)
        # Where all cameras have pixels that are not square, as in some video formats, nothing is odd.
        if min(abs(np.log(ratios[c])), abs(np.log(ratios[c] / usual))) > np.log1p(SQUARE):
            (fx, fy), percent = camera.focal_px, 100 * abs(ratios[c] - 1)
            problem = f"its focal lengths {fx:.0f} and {fy:.0f} px differ by {percent:.0f} %, those of the others by {100 * abs(usual - 1):.1f} %"
            sentences.append(f"camera '{camera.name}': {problem}: its calibration seems to have failed; calibrate it again.")
        if tangential[c] > max(TANGENTIAL, TIMES * _usual(tangential, c)):
            problem = f"its tangential distortion is {tangential[c]:.2g}, that of the others {_usual(tangential, c):.2g}"
            sentences.append(f"camera '{camera.name}': {problem}: its calibration seems to have failed; calibrate it again.")
    return sentences


def _usual(values: Sequence[float], c: int) -> float:
    return float(np.median([value for k, value in enumerate(values) if k != c]))


def _describe_divided(cameras: Sequence[CameraSpec], calibration: Path) -> list[str]:
    """A sentence on distortions that Pose2Sim's conversion has divided: only in a toml in which every coefficient of every camera is tiny."""
    coefficients = np.abs([camera.distortion[:4] for camera in cameras])
    if calibration.suffix != ".toml" or len(cameras) < 2 or not ((coefficients > 0) & (coefficients < DIVIDED)).all():
        return []
    problem = f"the distortion of every lens is far smaller than usual (k1 at most {coefficients[:, 0].max():.1g})"
    reason = f"Pose2Sim's conversion of Qualisys's files divides it by {SUBPIXELS:g}, by mistake"
    return [f"{calibration.name}: {problem}: {reason}; if this file was made so, give the *.qca.txt instead, or --rig distortion_64."]


def _describe_view(cameras: Sequence[CameraSpec], up: Axis) -> list[str]:
    lonely = _lonely(cameras) if len(cameras) > 1 else []
    if not lonely:
        return []
    if len(lonely) < len(cameras):
        view = "sees no place that another camera sees" if len(lonely) == 1 else "see no place that another camera sees"
        return [f"{_names(lonely)}: {view}: check rotation and translation."]
    rigs = {name: [change.apply(camera) for camera in cameras] for name, change in POSES.items()}
    changes = [name for name, rig in rigs.items() if not _lonely(rig)]
    # Most cameras stand upright: their y points down.
    changes.sort(key=lambda name: sum(camera.rotation[1, "xyz".index(up)] > 0 for camera in rigs[name]))
    options = " or ".join(f"--rig {name} ({POSES[name].meaning})" for name in changes[:MOST_LISTED])
    remedy = f"they would with {options}" if changes else "check rotations and translations, X_camera = R X_world + T"
    return [f"No two cameras see a common place: {remedy}."]


def _lonely(cameras: Sequence[CameraSpec]) -> list[CameraSpec]:
    """Return the cameras that see no place that another camera sees."""
    # Far outside of its pictures, a lens's distortion can lead back into them.
    lenses = [replace(camera, distortion=(0.0,) * 5) for camera in cameras]
    centres = np.array([-camera.rotation.T @ camera.translation_m for camera in cameras])
    farthest_m = max(FARTHEST_M, FARTHEST * float(np.linalg.norm(centres[:, None] - centres, axis=-1).max()))
    clouds = [_cloud(camera, farthest_m) for camera in lenses]
    sharing: set[int] = set()
    for a, camera in enumerate(lenses):
        # The next camera is usually the neighbour.
        partners = [(a + step) % len(lenses) for step in range(1, len(lenses))]
        partner = (
            _first(partners, lambda b, a=a, camera=camera: _sees(camera, clouds[b]) or _sees(lenses[b], clouds[a])) if a not in sharing else None
        )
        sharing.update(() if partner is None else (a, partner))
    return [camera for c, camera in enumerate(cameras) if c not in sharing]


def _first(candidates: Sequence[int], is_right: Callable[[int], bool]) -> int | None:
    return next((candidate for candidate in candidates if is_right(candidate)), None)


def _cloud(camera: CameraSpec, farthest_m: float) -> Float[np.ndarray, "point 3"]:
    """Return points of the world all over the view of a camera."""
    width, height = camera.size_px
    columns, rows = np.meshgrid(np.linspace(0, width - 1, GRID), np.linspace(0, height - 1, GRID))
    rays = undistorted_rays(camera, np.stack([columns.ravel(), rows.ravel()], axis=-1))
    rays = np.column_stack([rays, np.ones(len(rays))])
    points = (farthest_m * DEPTHS[:, None, None] * rays).reshape(-1, 3)
    return (points - camera.translation_m) @ camera.rotation


def _sees(camera: CameraSpec, points_m: Float[np.ndarray, "point 3"]) -> bool:
    pixels = project(camera, points_m)
    return bool(((pixels >= 0) & (pixels <= np.array(camera.size_px) - 1)).all(axis=-1).any())
