"""Complete the landmarks of a motion: gaps are filled, and hands, feet and neck are added if the file has none."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import input_error
from bayes_body.recording.evidence.markers import MARKERS

type Track = Float[np.ndarray, "frame 3"]
type Landmarks = Mapping[str, Track]

# As fractions of the forearm (wrist to finger ends over elbow to wrist, ANSUR 1988: 0.193 m and 0.27 m).
HAND_OVER_FOREARM = 0.70
# Ankle to the front end of the ball and to the sole, over the shank (0.19 m and 0.075 m over 0.41 m).
TOE_OVER_SHANK = 0.46
SOLE_OVER_SHANK = 0.18
# A foot is in stance if its ankle is within 3 cm of its lowest position.
STANCE_M = 0.03


def complete(landmarks: Landmarks) -> dict[str, Track]:
    """All landmarks of a person, known in every frame.

    Args:
        landmarks: the fifteen markers, and where known `l_hand`, `l_toe`, `neck` and so on; metres, z up, NaN in gaps.

    Returns:
        The fifteen and `neck`, `l_hand`, `r_hand`, `l_toe`, `r_toe`; float64 without NaN.

    Raises:
        InputError: a marker is missing, unknown in all frames, or not (frame, 3) like the others.
    """
    _check(landmarks)
    tracks = {name: _filled(name, track) for name, track in landmarks.items() if name in MARKERS or np.isfinite(track).any()}
    centre = (tracks["l_shoulder"] + tracks["r_shoulder"]) / 2
    tracks.setdefault("neck", centre + 0.12 * (tracks["head"] - centre))
    for side in ("l", "r"):
        wrist = tracks[f"{side}_wrist"]
        tracks.setdefault(f"{side}_hand", wrist + HAND_OVER_FOREARM * (wrist - tracks[f"{side}_elbow"]))
        tracks.setdefault(f"{side}_toe", _toe(tracks, side))
    return tracks


def _check(landmarks: Landmarks) -> None:
    missing = [name for name in MARKERS if name not in landmarks]
    if missing:
        raise input_error("the motion's landmarks", f"no {', '.join(missing)}", f"each of {', '.join(MARKERS)}", "name the file's joints")
    shape = landmarks["pelvis"].shape
    for name, track in landmarks.items():
        if track.shape != shape or track.ndim != 2 or track.shape[-1] != 3:
            raise input_error(
                f"the motion's {name}", f"shape {track.shape}", "(frame, 3), the same for all landmarks", "give the same number of frames for each"
            )


def _filled(name: str, track: Track) -> Track:
    """The track with its gaps interpolated over time."""
    track = np.asarray(track, np.float64)
    is_measured = np.isfinite(track).all(axis=1)
    if is_measured.all():
        return track
    if not is_measured.any():
        raise input_error(f"the motion's {name}", "unknown in every frame", "known in some frames", "choose a motion that has this marker")
    frames = np.arange(len(track))
    return np.stack([np.interp(frames, frames[is_measured], track[is_measured, axis]) for axis in range(3)], axis=1)


def _toe(landmarks: Mapping[str, Track], side: str) -> Track:
    """A toe in front of the ankle: the foot is flat on the floor in stance, and perpendicular to the shank when lifted."""
    ankle = landmarks[f"{side}_ankle"]
    shank = ankle - landmarks[f"{side}_knee"]
    length = np.linalg.norm(shank, axis=1, keepdims=True)
    hip_axis = landmarks["l_hip"] - landmarks["r_hip"]
    lifted, flat = np.cross(shank, hip_axis), np.cross(hip_axis, np.array([0.0, 0.0, 1.0]))
    height = ankle[:, 2:] - np.percentile(ankle[:, 2], 5)
    stance = np.clip(1.0 - height / STANCE_M, 0.0, 1.0)
    forward = stance * unit(flat) + (1.0 - stance) * unit(lifted)
    above = SOLE_OVER_SHANK * length * unit(np.cross(forward, hip_axis))
    return ankle + TOE_OVER_SHANK * length * unit(forward) - 0.8 * above


def unit(vectors: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """The directions of vectors; zero for a zero vector."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)
