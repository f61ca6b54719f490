"""Detections as proposals of message passing: for each part of a loose-limbed body, where to look. They are not factors of the density.

Detected parts and the parts of a body have different frames: a detected part has its axis along z, and x points to where the person faces
(`detection.detections`). The transform between the two frames is read from the body with all angles at 0, where it stands upright. Arms and feet
point forward or back in that pose, so their rotation about their axes is arbitrary; no detector measures it. A detected landmark gives the position
of a point of a part, and nothing about the part's rotation (`density.point_and_axis`).
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.base.config import FAST_COMPILE
from bayes_body.base.errors import input_error
from bayes_body.base.geometry import rigid, rotations
from bayes_body.base.geometry.namespaces import device_array
from bayes_body.base.geometry.transforms import Transform
from bayes_body.base.shapes import Configuration
from bayes_body.density.graph import Mixture
from bayes_body.density.point_and_axis import PointAndAxis
from bayes_body.density.spaces import SE3
from bayes_body.density.tangent_normal import WIDEST_RAD, TangentNormal, tangent_normal
from bayes_body.initial.detection.detect import Detected
from bayes_body.initial.detection.detections import Detections, axis_frames, strongest
from bayes_body.model.body.placed_body import placed_markers, require
from bayes_body.model.body.placement import PARTS, ByParts
from bayes_body.model.body.solids import Body, part_transforms

# Number of the strongest detections of a part, and of its landmarks, that make a proposal. It is fixed, so that no frame is traced again.
MOST = 12

# The markers that say which way a body at rest is up, and which way it faces.
TRUNK = ("l_hip", "r_hip", "pelvis", "thorax")

# The parameters of a distribution, without and with its weight.
type Parameters = tuple[np.ndarray, ...]
type Weighted = tuple[Parameters, float]


class Frames(NamedTuple):
    """The frame of each part's detections `X_part_detected`, and the body's markers at zero angles in the frames of their parts.

    Attributes:
        detected: by the part's name.
        landmarks: by landmark, the part's index and the point in its frame, metres.
    """

    detected: Mapping[str, Float[np.ndarray, "7"]]
    landmarks: Mapping[str, tuple[int, Float[np.ndarray, "3"]]]


def frames_of(body: Body) -> Frames:
    """Return how detections are attached to a loose-limbed body.

    Raises:
        InputError: the body is placed by angles, or lacks a marker of TRUNK.
    """
    placement = by_parts(body)
    missing = next((name for name in TRUNK if name not in body.markers.names), None)
    if missing:
        remedy = "take a person's body, or leave [detectors] out"
        raise input_error("detectors", f"the body '{body.name}' has no marker '{missing}'", f"the markers {', '.join(TRUNK)}", remedy)
    zero, markers, (rotation, base) = jax.tree.map(lambda leaf: np.asarray(leaf, float), _at_rest(body))
    marker_places = dict(zip(body.markers.names, markers, strict=True))
    # The cross product of an upright body's left and up.
    forward = np.cross(marker_places["l_hip"] - marker_places["r_hip"], marker_places["thorax"] - marker_places["pelvis"])
    detected = {}
    for part, name in enumerate(placement.names):
        solid = body.topology.names.index(name)
        axis = rotation[solid][:, 2]
        tip = base[solid] + float(body.lengths[solid]) * axis
        # The axes of trunk and head point to the crown; the axis of a limb points away from the trunk.
        towards = axis if "_" in name or axis @ (marker_places["thorax"] - marker_places["pelvis"]) > 0 else -axis
        frame = rigid.rigid((base[solid] + tip) / 2, rotations.from_matrix(axis_frames(towards[None], forward[None])[0]))
        detected[name] = np.asarray(rigid.relative(zero[part], frame), float)
    landmarks = {}
    for name, joint, place in zip(body.markers.names, body.markers.joints, markers, strict=True):
        part = placement.owners[joint]
        landmarks[name] = part, np.asarray(rigid.apply(rigid.inverse(zero[part]), place), float)
    return Frames(detected, landmarks)


@jax.jit(compiler_options=FAST_COMPILE)
def _at_rest(body: Body) -> tuple[Configuration, Float[Array, "marker 3"], Transform]:
    """Return the parts, the markers and the solids of a body with all angles at 0."""
    parts = by_parts(body).configuration(body.skeleton, jnp.zeros(len(body.dof_names), body.lengths.dtype))
    return parts, placed_markers(body, parts), part_transforms(body, parts)


def proposals_of(detected: Detected, body: Body, frames: Frames | None = None) -> tuple[Mixture, ...]:
    """Return a mixture of each part's detected rigid frames, and one of its landmarks. A part that was not detected has no proposal in them.

    Args:
        detected: what was detected in a frame.
        body: a body that is placed by parts.
        frames: `frames_of` the body, if it is known already.

    Raises:
        InputError: the body is placed by angles.
    """
    placement, frames = by_parts(body), frames or frames_of(body)
    of_parts: list[list[Weighted]] = [[] for _ in placement.names]
    of_landmarks: list[list[Weighted]] = [[] for _ in placement.names]
    for part, name in enumerate(placement.names):
        if name in detected.parts:
            of_parts[part] = _rigid(strongest(detected.parts[name], MOST), frames.detected[name])
    for name, (part, point) in frames.landmarks.items():
        if name in detected.landmarks:
            of_landmarks[part] += _points(strongest(detected.landmarks[name], MOST), point)
    strongest_points = [sorted(components, key=lambda component: -component[1])[:MOST] for components in of_landmarks]
    return _mixture(of_parts, (rigid.identity(), np.eye(6)), _normals), _mixture(strongest_points, _point(*np.eye(3)), PointAndAxis)


@jax.jit(compiler_options=FAST_COMPILE)
def _normals(means: Float[Array, "part component 7"], covariances: Float[Array, "part component 6 6"]) -> TangentNormal:
    """Return the normal distributions of rigid transforms with these moments."""
    return jax.vmap(jax.vmap(partial(tangent_normal, SE3())))(means, covariances)


def by_parts(body: Body) -> ByParts:
    """Return the placement of a body that is placed by parts.

    Raises:
        InputError: the body is placed by angles.
    """
    require(body, PARTS, "detections of parts", "detections of landmarks")
    assert isinstance(body.placement, ByParts)
    return body.placement


def _rigid(detections: Detections, X_part_detected: Float[np.ndarray, "7"]) -> list[Weighted]:
    """Return means and covariances of the part's frame, with their weights."""
    assert detections.rotations is not None
    turn, arm = np.asarray(rotations.to_matrix(X_part_detected[3:]), float), X_part_detected[:3]
    cross = np.array([[0, -arm[2], arm[1]], [arm[2], 0, -arm[0]], [-arm[1], arm[0], 0]])
    components = []
    for place, R_world_detected, sd_m, sd_rad, weight in zip(
        detections.positions, detections.rotations, detections.sd_m, detections.sd_rad, detections.weights, strict=True
    ):
        R_world_part = R_world_detected @ turn.T
        mean = np.concatenate([place - R_world_part @ arm, rotations.from_matrix(R_world_part)])
        # A rotation about the middle of the axis also moves the origin of the part's frame.
        spread = np.zeros((6, 6))
        spread[:3, :3], spread[:3, 3:], spread[3:, 3:] = R_world_detected, R_world_part @ cross @ turn, turn
        spread = spread * np.concatenate([sd_m, np.minimum(sd_rad, WIDEST_RAD)])
        components.append(((mean, spread @ spread.T), float(weight)))
    return components


def _points(detections: Detections, point: Float[np.ndarray, "3"]) -> list[Weighted]:
    """Return the parameters of distributions of the part's frame, with their weights; only one point of the part is known."""
    return [
        (_point(place, point, sd_m), float(weight))
        for place, sd_m, weight in zip(detections.positions, detections.sd_m, detections.weights, strict=True)
    ]


def _point(place: np.ndarray, point: np.ndarray, sd_m: np.ndarray) -> Parameters:
    """Return the parameters of a `PointAndAxis` whose axis points anywhere."""
    anywhere = np.array([0.0, 0.0, 1.0])
    return place, point, sd_m, anywhere, anywhere, np.zeros(())


def _mixture(by_part: Sequence[Sequence[Weighted]], filling: Parameters, distributions: Callable[..., Any]) -> Mixture:
    """Return the mixture, with MOST components for each part; missing ones are `filling`, without weight. `distributions` takes all parameters."""
    weights = np.full((len(by_part), MOST), -np.inf)
    for part, part_components in enumerate(by_part):
        total = sum(weight for _, weight in part_components)
        for number, (_, weight) in enumerate(part_components):
            weights[part, number] = np.log(weight / total) if weight > 0 else -np.inf
    components = [[*(component for component, _ in part_components), *[filling] * (MOST - len(part_components))] for part_components in by_part]
    stacked = (device_array([[component[k] for component in row] for row in components]) for k in range(len(filling)))
    return Mixture(distributions(*stacked), device_array(weights))
