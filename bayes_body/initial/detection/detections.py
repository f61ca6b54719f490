r"""What detectors return for a part or a landmark: a mixture of rigid normals, $f(X) = \sum_n w_n\, \mathcal N(X; X_n, \Lambda_n)$.

The mixture is that of Sigal, Isard, Haussecker & Black (2011, equations 11 to 13), with diagonal $\Lambda_n$.

A landmark is one of the fifteen markers (`bayes_body.recording.evidence.markers`; `head` is the crown) and has a position only. A part has a rigid
pose:

- z points from the part's proximal to its distal end; for pelvis, torso and head it points from the hips to the crown.
- x points to where the person faces; `sd_rad[:, 2]` is large where that is unknown.
- its origin is the middle of its axis; for the head, the middle of the skull.

Most detectors cannot tell left from right. They give the same detections to both sides.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bayes_body.recording.evidence.markers import MARKERS

LANDMARKS = MARKERS
# The parts of Sigal et al. 2011, Fig. 1 (15 parts), by the names of the bodies that ship.
PARTS = (
    *("pelvis", "torso", "head"),
    *(side + part for side in ("l_", "r_") for part in ("upper_arm", "forearm", "hand", "thigh", "calf", "foot")),
)
# Standard deviation of an unknown angle: that of the uniform distribution on a circle.
UNKNOWN_RAD = float(np.pi / np.sqrt(3))

# Shorter segments have no direction; standard deviation of a direction between two uncertain ends.
LEAST_LENGTH_M, SD_TILT_RAD = 0.03, 0.35


class Detections(NamedTuple):
    """Weighted poses of one part, or weighted positions of one landmark.

    Attributes:
        positions: the part's origin (see the module), or the landmark, in the world, metres.
        rotations: `T_world_part`'s rotations; None for a landmark.
        sd_m: standard deviations of the position along the part's axes; along the world's axes for a landmark. Metres.
        sd_rad: standard deviations of the rotation vector in the part's frame, radians; `UNKNOWN_RAD` where nothing is known.
        weights: they sum to 1, or there are none.
        source: the name of each detection's detector.
    """

    positions: Float[np.ndarray, "detection 3"]
    rotations: Float[np.ndarray, "detection 3 3"] | None
    sd_m: Float[np.ndarray, "detection 3"]
    sd_rad: Float[np.ndarray, "detection 3"]
    weights: Float[np.ndarray, " detection"]
    source: tuple[str, ...]


class Person(NamedTuple):
    """Where the person stands.

    Attributes:
        floor_m: the point of the floor below the pelvis, in the world, metres.
        height_m: distance from the floor to the crown in the present pose, metres; the stature if the person stands.
        facing: horizontal unit vector to where the person faces, if `facing_known`; else this or the opposite vector; None if nothing is known.
        facing_known: whether a face or keypoints distinguish the facing from its opposite.
    """

    floor_m: Float[np.ndarray, "3"]
    height_m: float
    facing: Float[np.ndarray, "3"] | None
    facing_known: bool


class Found(NamedTuple):
    """What one detector found: detections of landmarks and of parts by name, the person if it tells, and sentences for the reader."""

    landmarks: Mapping[str, Detections]
    parts: Mapping[str, Detections]
    notices: tuple[str, ...] = ()
    person: Person | None = None


def landmark(positions: Float[np.ndarray, "detection 3"], sd_m: float | np.ndarray, weights: np.ndarray, source: str) -> Detections:
    """Return detections of a landmark; `sd_m` is one number, or broadcasts to (detection, 3). Weights are normalised."""
    positions = np.asarray(positions, float).reshape(-1, 3)
    sds = np.broadcast_to(np.asarray(sd_m, float), positions.shape).copy()
    return Detections(positions, None, sds, np.full(positions.shape, UNKNOWN_RAD), _normalised(weights), (source,) * len(positions))


def part(
    positions: Float[np.ndarray, "detection 3"],
    rotations: Float[np.ndarray, "detection 3 3"],
    sd_m: float | np.ndarray,
    sd_rad: float | np.ndarray,
    weights: np.ndarray,
    source: str,
) -> Detections:
    """Return detections of a part; `sd_m` and `sd_rad` broadcast to (detection, 3). Weights are normalised."""
    positions = np.asarray(positions, float).reshape(-1, 3)
    rotations = np.asarray(rotations, float).reshape(-1, 3, 3)
    sds = [np.broadcast_to(np.asarray(sd, float), positions.shape).copy() for sd in (sd_m, sd_rad)]
    return Detections(positions, rotations, sds[0], sds[1], _normalised(weights), (source,) * len(positions))


def every_facing(
    middle: Float[np.ndarray, "3"],
    axis: Float[np.ndarray, "3"],
    facings: Float[np.ndarray, "direction 3"],
    sd_m: float | np.ndarray,
    sd_tilt_rad: float,
    weights: np.ndarray,
    source: str,
) -> Detections:
    """Return detections of an upright part at one place, one for each direction in which the person may face, all round the circle."""
    rotations = axis_frames(np.tile(axis, (len(facings), 1)), facings)
    sd_rad = np.array([sd_tilt_rad, sd_tilt_rad, np.pi / len(facings)])
    return part(np.tile(middle, (len(facings), 1)), rotations, sd_m, sd_rad, weights, source)


def segments(
    proximal: Float[np.ndarray, "detection 3"], distal: Float[np.ndarray, "detection 3"], sd_m: float | np.ndarray, weights: np.ndarray, source: str
) -> Detections:
    """Return detections of a part whose two ends are known, but not its twist. Segments without a length are left out."""
    axes = np.asarray(distal - proximal, float).reshape(-1, 3)
    has_length = np.linalg.norm(axes, axis=1) > LEAST_LENGTH_M
    middles, axes = (proximal + distal).reshape(-1, 3)[has_length] / 2, axes[has_length]
    sds = np.array([SD_TILT_RAD, SD_TILT_RAD, UNKNOWN_RAD])
    return part(middles, axis_frames(axes, np.zeros_like(axes)), sd_m, sds, np.asarray(weights)[has_length], source)


def merge(mixtures: Sequence[tuple[Detections, float]]) -> Detections | None:
    """Return several mixtures as one, each with its share of the weight; None if there are no detections."""
    mixtures = [(mixture, share) for mixture, share in mixtures if len(mixture.weights)]
    if not mixtures:
        return None
    rotations = [mixture.rotations for mixture, _ in mixtures if mixture.rotations is not None]
    return Detections(
        np.concatenate([mixture.positions for mixture, _ in mixtures]),
        np.concatenate(rotations) if rotations else None,
        np.concatenate([mixture.sd_m for mixture, _ in mixtures]),
        np.concatenate([mixture.sd_rad for mixture, _ in mixtures]),
        _normalised(np.concatenate([share * mixture.weights for mixture, share in mixtures])),
        tuple(name for mixture, _ in mixtures for name in mixture.source),
    )


def strongest(detections: Detections, most: int) -> Detections:
    """Return the `most` detections with the largest weights, the strongest first."""
    return chosen(detections, np.argsort(-detections.weights, kind="stable")[:most])


def chosen(detections: Detections, rows: Int[np.ndarray, " row"]) -> Detections:
    """Return some of the detections, with their weights normalised."""
    rotations = None if detections.rotations is None else detections.rotations[rows]
    return Detections(
        detections.positions[rows],
        rotations,
        detections.sd_m[rows],
        detections.sd_rad[rows],
        _normalised(detections.weights[rows]),
        tuple(detections.source[k] for k in rows),
    )


def axis_frames(axes: Float[np.ndarray, "detection 3"], forward: Float[np.ndarray, "detection 3"]) -> Float[np.ndarray, "detection 3 3"]:
    """Return rotations with z along `axes` and x as near to `forward` as possible; if the two are parallel, x is any perpendicular direction."""
    z = axes / np.linalg.norm(axes, axis=-1, keepdims=True)
    x = forward - (forward * z).sum(axis=-1, keepdims=True) * z
    least = np.eye(3)[np.argmin(np.abs(z), axis=-1)]
    parallel = np.linalg.norm(x, axis=-1, keepdims=True) < 1e-6
    x = np.where(parallel, least - (least * z).sum(axis=-1, keepdims=True) * z, x)
    x = x / np.linalg.norm(x, axis=-1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=-1)


def _normalised(weights: np.ndarray) -> Float[np.ndarray, " detection"]:
    weights = np.asarray(weights, float).ravel()
    return weights / weights.sum() if len(weights) else weights
