r"""The points of a body that markers and keypoints measure, by name; and the lengths of the body that are fitted together with its pose.

A name is one of the body's virtual markers, a synonym of one, or a point of the face. The points of the face follow from the crown and the
shoulders: the shoulders define left and right, and the head's axis defines up; together they define forward. The offsets of the face's points are
fractions of the distance from the head's joint to the crown. They come from ANSUR II (Gordon et al. 2014), means of 4082 men: tragion to top of
head 130 mm, bitragion breadth 145 mm, distance between the pupils 64 mm.

The fitted lengths are $\ell_k = \bar\ell_k e^{\sigma z_{g(k)}}$, $z \sim N(0, 1)$, with one z for a left and right pair. A body is affine in its
lengths: the offsets of joints, markers and parts are constants plus named lengths with a sign. To find the contribution of a length, the body is
built with that length alone.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.base.config import FAST_COMPILE
from bayes_body.base.geometry import transforms
from bayes_body.base.geometry.namespaces import device_array
from bayes_body.model.body.build import Shape, build_body
from bayes_body.model.body.kinematics import forward_kinematics
from bayes_body.model.body.schema import BodySchema
from bayes_body.model.body.skeleton import Markers
from bayes_body.model.body.solids import Body

# Detectors' names of points that are joint centres of the body.
OTHER_NAMES = {"neck": "thorax", "mid_hip": "pelvis"}
# Forward, left and up, as fractions of the distance from the head's joint to the crown.
FACE = {
    "nose": (0.38, 0.0, 0.48),
    "l_eye": (0.30, 0.10, 0.63),
    "r_eye": (0.30, -0.10, 0.63),
    "l_ear": (0.05, 0.23, 0.58),
    "r_ear": (0.05, -0.23, 0.58),
}
# Tolerances, metres. Networks put hips outside and above the joint's centre; the crown and the points of the face are not joints.
LOOSE_M = {"l_hip": 0.04, "r_hip": 0.04, "pelvis": 0.04, "thorax": 0.04, "head": 0.04, **dict.fromkeys(FACE, 0.06)}
TIGHT_M = 0.02
FACE_WEIGHT = 0.3
# Pairs of points: in a person who stands at rest, the first is below the second; on the left, on the right or in the middle.
HANGING = (("elbow", "shoulder"), ("wrist", "elbow"), ("knee", "hip"), ("ankle", "knee"), ("pelvis", "thorax"), ("thorax", "head"))


@partial(jax.tree_util.register_dataclass, meta_fields=["names", "joints", "crown"], data_fields=["face"])
@dataclass(frozen=True)
class Points:
    """The points of one body that can be measured.

    Attributes:
        names: names of the body's virtual markers, then of the points of its face.
        joints: each point's joint.
        crown: index of the marker that is the crown; 0 for a body without a head.
        face: offsets of the face's points in the head joint's frame, as fractions of the crown's distance; no rows for a body without a head.
    """

    names: tuple[str, ...]
    joints: tuple[int, ...]
    crown: int
    face: Float[Array, "face 3"]

    @property
    def tolerance_m(self) -> Float[np.ndarray, " point"]:
        """Expected distance between the positions of the same point in two sources, metres."""
        return np.array([LOOSE_M.get(name, TIGHT_M) for name in self.names])

    @property
    def weight(self) -> Float[np.ndarray, " point"]:
        """The weight of each point."""
        return np.array([FACE_WEIGHT if name in FACE else 1.0 for name in self.names])

    @property
    def hanging(self) -> Float[np.ndarray, " point"]:
        """The pull on each point of a person at rest, down (above 0) or up: 1 for a point that hangs, -1 for the point from which it hangs."""
        pulls = np.zeros(len(self.names))
        for end, base in HANGING:
            for side in ("l_", "r_", ""):
                if side + end in self.names and side + base in self.names:
                    pulls[self.names.index(side + end)] += 1
                    pulls[self.names.index(side + base)] -= 1
        return pulls

    def index(self, name: str) -> int | None:
        """Return the index of the point of that name, a detector's or the body's own; None if the body has no such point."""
        name = OTHER_NAMES.get(name, name)
        return self.names.index(name) if name in self.names else None


def body_points(body: Body) -> Points:
    """Return the points of a body. It has a face only if it has a marker `head`, above its joint, and a pair of markers `l_...`, `r_...`."""
    markers = body.markers
    frame = _facing(body)
    if frame is None:
        return Points(markers.names, markers.joints, 0, device_array(np.zeros((0, 3)), body.lengths.dtype))
    crown = markers.names.index("head")
    face = np.array([list(fraction) for fraction in FACE.values()]) @ np.asarray(frame, float)
    return Points((*markers.names, *FACE), (*markers.joints, *[markers.joints[crown]] * len(FACE)), crown, device_array(face, frame.dtype))


def as_markers(body: Body, points: Points) -> Markers:
    """Return the points as markers of this body, whose lengths may have changed since `body_points`."""
    if not points.face.shape[0]:
        return body.markers
    return replace(body.markers, names=points.names, joints=points.joints, offsets=_with_face(body.markers.offsets, points))


@jax.jit
def _with_face(offsets: Float[Array, "marker 3"], points: Points) -> Float[Array, "point 3"]:
    crown = offsets[points.crown]
    return jnp.concatenate([offsets, points.face * jnp.sqrt(transforms.dot(crown, crown))])


def _facing(body: Body) -> Float[Array, "3 3"] | None:
    """Return forward, left and up, one row each, in the head joint's frame, in the pose in which all angles are 0."""
    names = body.markers.names
    pairs = [(name, "r_" + name[2:]) for name in names if name.startswith("l_") and "r_" + name[2:] in names]
    if "head" not in names or not pairs:
        return None
    left_marker, right_marker = (names.index(name) for name in pairs[0])
    return _head_frame(body, names.index("head"), left_marker, right_marker)


@partial(jax.jit, static_argnames=("crown", "left_marker", "right_marker"), compiler_options=FAST_COMPILE)
def _head_frame(body: Body, crown: int, left_marker: int, right_marker: int) -> Float[Array, "3 3"]:
    markers, T_world_joints = body.markers, forward_kinematics(body.skeleton, jnp.zeros(len(body.dof_names), body.lengths.dtype))
    places = [transforms.apply(transforms.pick(T_world_joints, markers.joints[m]), markers.offsets[m]) for m in (crown, left_marker, right_marker)]
    T_world_head = transforms.pick(T_world_joints, markers.joints[crown])
    up = transforms.unit(places[0] - T_world_head.origin)
    sideways = places[1] - places[2]
    aside = transforms.unit(sideways - transforms.dot(sideways, up) * up)
    rows = [jnp.cross(aside, up), aside, up]
    return jnp.stack([jnp.stack([transforms.dot(axis, row) for axis in (T_world_head.x, T_world_head.y, T_world_head.z)]) for row in rows])


# Standard deviation of a length's logarithm: how much a person's segments differ from average proportions.
SPREAD = 0.1


class Fields(NamedTuple):
    """The arrays of a body that depend on its lengths, metres; in `Scaling.contributions`, with a leading axis of lengths."""

    joints: Float[Array, "*length joint 3"]
    markers: Float[Array, "*length marker 3"]
    parts: Float[Array, "*length part 3"]
    lengths: Float[Array, "*length part"]


class Scaling(NamedTuple):
    """How a body changes with its lengths.

    Attributes:
        values: the body's lengths, metres; empty if they are not fitted.
        groups: 1 where a length (row) depends on a parameter (column).
        contributions: what each length adds to the body's arrays.
    """

    values: Float[Array, " length"]
    groups: Float[Array, "length group"]
    contributions: Fields


def fixed(body: Body) -> Scaling:
    """Return the scaling of a body with constant lengths: it has no parameters."""
    no_fields = jax.tree.map(lambda leaf: device_array(np.zeros((0, *leaf.shape)), leaf.dtype), fields(body))
    dtype = body.lengths.dtype
    return Scaling(device_array(np.zeros(0), dtype), device_array(np.zeros((0, 0)), dtype), no_fields)


def scaling(body: Body, schema: BodySchema) -> Scaling:
    """Return the scaling in which all lengths of a body are parameters; left and right share one."""
    names = tuple(schema.lengths_of_height)
    no_lengths = dict.fromkeys(names, 0.0)
    constant = _flat(build_body(body.name, schema, Shape(1.0, no_lengths)))
    rows = np.stack([_flat(build_body(body.name, schema, Shape(1.0, no_lengths | {name: 1.0}))) - constant for name in names])
    # The lengths with which this body was built; a length on which nothing depends is 0 here.
    values = np.linalg.lstsq(rows.T, _flat(body) - constant, rcond=None)[0]
    dtype = body.lengths.dtype
    return Scaling(jnp.asarray(values, dtype), jnp.asarray(_groups(names), dtype), _unflat(values[:, None] * rows, body))


def scaled(body: Body, change: Scaling, z: Float[Array, " group"]) -> Body:
    """Return the body with the lengths that belong to the parameters z."""
    if not change.values.shape[0]:
        return body
    growth = factors(change, z) - 1
    scaled_fields = jax.tree.map(lambda base, contribution: base + jnp.tensordot(growth, contribution, 1), fields(body), change.contributions)
    skeleton, markers = replace(body.skeleton, offsets=scaled_fields.joints), replace(body.markers, offsets=scaled_fields.markers)
    return replace(body, skeleton=skeleton, markers=markers, offsets=scaled_fields.parts, lengths=scaled_fields.lengths)


def factors(change: Scaling, z: Float[Array, " group"]) -> Float[Array, " length"]:
    """Return the factor applied to each length."""
    return jnp.exp(SPREAD * (change.groups @ z))


def fields(body: Body) -> Fields:
    """Return the arrays of a body that depend on its lengths."""
    return Fields(body.skeleton.offsets, body.markers.offsets, body.offsets, body.lengths)


def _flat(body: Body) -> Float[np.ndarray, " entry"]:
    return np.concatenate([np.asarray(field, float).ravel() for field in fields(body)])


def _unflat(rows: Float[np.ndarray, "length entry"], body: Body) -> Fields:
    shapes = fields(body)
    cuts = np.cumsum([field.size for field in shapes])[:-1]
    pieces = np.split(rows, cuts, axis=1)
    return Fields(*(jnp.asarray(piece.reshape(-1, *field.shape), field.dtype) for piece, field in zip(pieces, shapes, strict=True)))


def _groups(names: tuple[str, ...]) -> Float[np.ndarray, "length group"]:
    stems = [name[2:] if name.startswith(("l_", "r_")) else name for name in names]
    kinds = list(dict.fromkeys(stems))
    return np.array([[float(stem == kind) for kind in kinds] for stem in stems])
