r"""The points of a body that markers and keypoints measure, by name; and the lengths of the body that are fitted together with its pose.

A name is one of the body's virtual markers, a synonym of one, or a point of the face. The points of the face follow from the crown and the
shoulders: the shoulders define left and right, and the head's axis defines up; together they define forward. The offsets of the face's points are
fractions of the distance from the head's joint to the crown. They come from ANSUR II (Gordon et al. 2014), means of 4082 men: tragion to top of
head 130 mm, bitragion breadth 145 mm, distance between the pupils 64 mm.

The fitted lengths are $\ell_k = \bar\ell_k e^{\sigma z_{g(k)}}$, $z \sim N(0, 1)$, with one z for a left and right pair.
"""

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.base.config import FAST_COMPILE
from bayes_body.base.geometry import transforms
from bayes_body.base.geometry.namespaces import device_array
from bayes_body.model.body.kinematics import forward_kinematics
from bayes_body.model.body.lengths import Scaling, with_factors
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


def scaled(body: Body, change: Scaling, z: Float[Array, " group"]) -> Body:
    """Return the body with the lengths that belong to the parameters z."""
    return body if not change.values.shape[0] else with_factors(body, change, factors(change, z))


def factors(change: Scaling, z: Float[Array, " group"]) -> Float[Array, " length"]:
    """Return the factor applied to each length."""
    return jnp.exp(SPREAD * (change.groups @ z))
