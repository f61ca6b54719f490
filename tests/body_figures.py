"""Stick figures of a body's proportions: what keypoint networks see of a person who moves, in the order of a layout."""

import numpy as np

from bayes_body.recording.readers.keypoints.openpose import LAYOUTS
from bayes_body.recording.readers.keypoints.proportions import LIMBS

# Places in the body's frame as shares of stature: x to the left, y up, z forward.
HEAD = {
    **{"nose": (0, 0.92, 0.07), "head": (0, 1.0, 0), "upper_neck": (0, 0.86, 0.01), "neck": (0, 0.82, 0)},
    **{"l_eye": (0.018, 0.935, 0.055), "l_ear": (0.042, 0.925, 0.01)},
}
TRUNK = {"l_shoulder": (0.105, 0.82, 0), "l_hip": (0.055, 0.535, 0), "mid_hip": (0, 0.535, 0)}
FOOT = {"heel": (0, -0.035, -0.03), "big_toe": (-0.012, -0.035, 0.1), "small_toe": (0.022, -0.035, 0.085)}
# Angles of the limbs about the axis from right to left, radians: mean and amplitude of a swing; the other side is half a cycle later.
SWINGS = {("shoulder", "elbow"): (0.0, 0.4), ("elbow", "wrist"): (0.4, 0.4), ("hip", "knee"): (0.1, 0.45), ("knee", "ankle"): (-0.35, 0.3)}


def figures(layout, count=40, height_m=1.7):
    """A walking person (count, keypoint, 3) in the order of a layout, metres; y up. Points of hands and face are near wrist and nose."""
    phase = np.linspace(0, 4 * np.pi, count, endpoint=False)
    points = {name: np.tile(place, (count, 1)).astype(float) for name, place in (HEAD | TRUNK).items()}
    points |= {name.replace("l_", "r_", 1): place * [-1, 1, 1] for name, place in points.items() if name.startswith("l_")}
    for side, (mirror, later) in {"l": (1, 0.0), "r": (-1, np.pi)}.items():
        for (upper, lower), (mean, amplitude) in SWINGS.items():
            angle = mean + amplitude * np.sin(phase + later + (np.pi if upper == "shoulder" else 0.0))
            direction = np.stack([np.full(count, 0.05 * mirror), -np.cos(angle), np.sin(angle)], axis=-1)
            direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
            points[f"{side}_{lower}"] = points[f"{side}_{upper}"] + LIMBS[upper, lower] * direction
        for name, place in FOOT.items():
            points[f"{side}_{name}"] = points[f"{side}_ankle"] + np.array(place) * [mirror, 1, 1]
    rng = np.random.default_rng(5)
    for name in LAYOUTS[layout]:
        if name not in points:
            points[name] = points["nose" if name.startswith("face") else f"{name[0]}_wrist"] + rng.normal(0, 0.02, 3)
    return height_m * np.stack([points[name] for name in LAYOUTS[layout]], axis=1)


def seen_by(points, count=1, wrong=0.0, seed=11):
    """What distant cameras see of points (frame, keypoint, 3): (camera, frame, keypoint, 2), pixels; a share of them is wrong, some are missing."""
    rng = np.random.default_rng(seed)
    views = []
    for turn in np.pi / 5 + np.arange(count) * np.pi / count:
        across = points[..., 0] * np.cos(turn) + points[..., 2] * np.sin(turn)
        pixels = 200 * np.stack([across, -points[..., 1]], axis=-1) + [320, 440] + rng.normal(0, 2, (*points.shape[:2], 2))
        pixels = np.where(rng.random(points.shape[:2])[..., None] < wrong, rng.uniform(0, [640, 480], pixels.shape), pixels)
        views.append(np.where(rng.random(points.shape[:2])[..., None] < 0.02, np.nan, pixels))
    return np.stack(views)
