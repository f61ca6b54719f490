"""Resample a motion: cubic Hermite interpolation of positions, shortest rotation between orientations. Unknown values stay unknown."""

import dataclasses

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from bayes_body.base.errors import input_error
from bayes_body.recording.readers.mocap.capture import FASTEST_FPS
from bayes_body.recording.readers.mocap.motion import Motion

# A time nearer to a frame than this fraction of the frame interval is that frame.
SAME = 1e-6
MOST_FRAMES = 10_000_000


def resample(motion: Motion, fps: float) -> Motion:
    """The motion at `fps` frames per second, from its first frame to at most its last.

    A new frame that coincides with an old one equals it: from 120 to 60, every second frame is taken. Everything between a known and an unknown
    position is unknown.

    Raises:
        InputError: an invalid rate, or one that gives more than 10 million frames.
    """
    if not 0 < fps <= FASTEST_FPS:
        raise input_error("fps", f"{fps:g}", f"a number above 0, at most {FASTEST_FPS:g}", "give another rate")
    last = len(motion.positions_m) - 1
    count = int(last * fps / motion.fps * (1 + 1e-12) + SAME) + 1
    if count > MOST_FRAMES:
        raise input_error("fps", f"{fps:g}, {count} frames", f"at most {MOST_FRAMES} frames", "give a lower rate")
    places = np.arange(count) * (motion.fps / fps)
    nearest = np.rint(places)
    places = np.where(np.abs(places - nearest) < SAME * np.maximum(nearest, 1), nearest, places).clip(0, last)
    lower = np.minimum(places.astype(int), max(last - 1, 0))
    share = places - lower
    rotations = None if motion.rotations is None else _turned(motion.rotations, lower, share)
    return dataclasses.replace(motion, fps=float(fps), positions_m=_placed(motion.positions_m, lower, share), rotations=rotations)


def _placed(
    positions: Float[np.ndarray, "old joint 3"], lower: Int[np.ndarray, " frame"], share: Float[np.ndarray, " frame"]
) -> Float[np.ndarray, "frame joint 3"]:
    """Hermite interpolation between two frames. The slope at a frame is the mean of the velocities on both sides, or the one that is known."""
    upper = np.minimum(lower + 1, len(positions) - 1)
    t = share[:, None, None]
    p, q = positions[lower], positions[upper]
    slopes = _slopes(positions)
    u, v = slopes[lower], slopes[upper]
    between = p + t * (u + t * (3 * (q - p) - 2 * u - v + t * (2 * (p - q) + u + v)))
    return np.where(t == 0, p, np.where(t == 1, q, between))


def _slopes(positions: Float[np.ndarray, "frame joint 3"]) -> Float[np.ndarray, "frame joint 3"]:
    steps = np.diff(positions, axis=0)
    no_step = np.full_like(positions[:1], np.nan)
    backward, forward = np.concatenate([no_step, steps]), np.concatenate([steps, no_step])
    return np.where(np.isnan(backward), forward, np.where(np.isnan(forward), backward, (backward + forward) / 2))


def _turned(
    rotations: Float[np.ndarray, "old joint 3 3"], lower: Int[np.ndarray, " frame"], share: Float[np.ndarray, " frame"]
) -> Float[np.ndarray, "frame joint 3 3"]:
    upper = np.minimum(lower + 1, len(rotations) - 1)
    out = rotations[np.where(share == 1, upper, lower)].copy()
    frames = np.flatnonzero((share > 0) & (share < 1))
    start, end = rotations[lower[frames]], rotations[upper[frames]]
    is_missing = np.isnan(start).any(axis=(-1, -2)) | np.isnan(end).any(axis=(-1, -2))
    start, end = (Rotation.from_matrix(np.where(is_missing[..., None, None], np.eye(3), R).reshape(-1, 3, 3)) for R in (start, end))
    turn = (start.inv() * end).as_rotvec() * np.repeat(share[frames], out.shape[1])[:, None]
    out[frames] = (start * Rotation.from_rotvec(turn)).as_matrix().reshape(-1, *out.shape[1:])
    out[frames[:, None], np.arange(out.shape[1])] = np.where(is_missing[..., None, None], np.nan, out[frames])
    return out
