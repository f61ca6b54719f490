"""A walk drawn from sines, for tests that need somebody to be somewhere."""

import numpy as np

FPS = 60.0
STANDING = {
    **{"pelvis": (0, 0, 0.92), "thorax": (0, 0, 1.44), "head": (0.02, 0, 1.75)},
    **{"l_shoulder": (0, 0.18, 1.42), "l_elbow": (-0.02, 0.22, 1.13), "l_wrist": (0.06, 0.24, 0.89)},
    **{"l_hip": (0, 0.09, 0.91), "l_knee": (0.02, 0.1, 0.49), "l_ankle": (0, 0.1, 0.08)},
}


def walker(frames=60, fps=FPS):
    """A walk along x drawn from sines: legs and arms swing as pendulums with hinges, one stride a second."""
    time = np.arange(frames) / fps
    swing = np.sin(2 * np.pi * time)
    shift = np.stack([1.2 * time, 0 * time, 0.02 * np.cos(4 * np.pi * time)], axis=1)
    whole = {name: np.array(place) + shift for name, place in STANDING.items()}
    for side, sign in (("l", 1.0), ("r", -1.0)):
        mirror = np.array([1.0, sign, 1.0])
        hip, shoulder = (np.array(STANDING[f"l_{name}"]) * mirror + shift for name in ("hip", "shoulder"))
        thigh, upper = 0.42 * sign * swing, -0.35 * sign * swing
        knee = np.clip(0.15 + 0.75 * np.sin(2 * np.pi * time + (0.7 if sign > 0 else 0.7 + np.pi)), 0.08, None)
        whole |= {f"{side}_hip": hip, f"{side}_shoulder": shoulder}
        whole[f"{side}_knee"] = hip + 0.42 * _down(thigh)
        whole[f"{side}_ankle"] = whole[f"{side}_knee"] + 0.41 * _down(thigh - knee)
        whole[f"{side}_elbow"] = shoulder + 0.30 * _down(upper)
        whole[f"{side}_wrist"] = whole[f"{side}_elbow"] + 0.25 * _down(upper + 0.5)
    return whole


def _down(angle):
    return np.stack([np.sin(angle), 0 * angle, -np.cos(angle)], axis=1)
