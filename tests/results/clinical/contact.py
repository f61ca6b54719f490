"""When the feet of a captured person touch the floor, by the speed of heel and toes: independent of where the ankles are relative to the pelvis.

Ghoussayni, Stevens, Durham & Ewins 2004, Assessment and validation of a simple automated method for the detection of gait events and intervals: a
foot strikes when its heel becomes slower than 0.5 m/s in the sagittal plane, and leaves the floor when its toes become faster. Here the swing is the
whole time around a peak of the speed in which it is above that.
"""

import numpy as np
from scipy.signal import butter, filtfilt, find_peaks

from bayes_body.recording.readers.mocap import landmarks, read_motion

LIMIT, SWING = 0.5, 1.2


def captured(path):
    """The positions of the landmarks (m, z up), the frame rate, and by foot the true strikes and toe offs, s."""
    motion = read_motion(path)
    places = landmarks(motion)
    way = places["pelvis"][-1, :2] - places["pelvis"][0, :2]
    way = np.append(way / np.linalg.norm(way), 0)
    found = {}
    for side in "rl":
        toes = motion.positions_m[:, motion.joints.index(f"{side}toes")]
        foot = motion.rotations[:, motion.joints.index(f"{side}foot")]
        heel_swings, toe_swings = (_swings(point, way, motion.fps) for point in (_heel(places[f"{side}_ankle"], foot, toes), toes))
        found["foot strike", side] = [end for _, end in heel_swings]
        found["toe off", side] = [start for start, _ in toe_swings]
    return places, motion.fps, found


def _heel(ankle, foot, toes):
    """The skeletons have no heel: it is on the floor below the ankle, 5 cm behind it, in the tenth of the frames in which the ankle is slowest."""
    slow = np.argsort(np.linalg.norm(np.gradient(ankle, axis=0), axis=1))[: len(ankle) // 10]
    ahead = (toes - ankle)[slow] * (1, 1, 0)
    below = np.zeros_like(ahead)
    below[:, 2] = np.percentile(toes[:, 2], 5) - ankle[slow, 2]
    offsets = below - 0.05 * ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    return ankle + foot @ np.median(np.einsum("fba,fb->fa", foot[slow], offsets), axis=0)


def _swings(point, way, fps):
    """Start and end of every swing, s; NaN where the recording begins or ends in it."""
    moved = np.gradient(filtfilt(*butter(2, 12 / (fps / 2)), point, axis=0), axis=0) * fps
    speed = np.hypot(moved @ way, moved[:, 2])
    above = speed - LIMIT
    crossings = np.flatnonzero(above[:-1] * above[1:] < 0)
    times = (crossings + above[crossings] / (above[crossings] - above[crossings + 1])) / fps
    swings = []
    for peak in find_peaks(speed, height=SWING, distance=int(0.5 * fps), prominence=1.0)[0] / fps:
        before, after = times[times < peak], times[times > peak]
        swings.append((before[-1] if len(before) else np.nan, after[0] if len(after) else np.nan))
    return swings
