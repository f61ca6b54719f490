"""Rotations and rigid transforms as spaces. Their reference measure is Haar measure (`geometry.rotations`), for rigid transforms times volume.

A tangent vector at a placement X_a_b is a translation along the axes of frame a, metres, and a rotation vector in frame b, radians. So `torso_rz` is
a rotation about the torso's own long axis. Neither distances nor volumes change if frame a moves.
"""

from dataclasses import dataclass

from bayes_body.base.geometry import rigid, rotations
from bayes_body.base.geometry.namespaces import joined, namespace
from bayes_body.density.spaces.flat import TURN, length
from bayes_body.density.spaces.space import Axis, Numbers, Points, Vectors, Weights

# Number of steps from the extrinsic to the intrinsic mean of rotations. Each step multiplies the error by about the square of the spread.
MEAN_STEPS = 5
# Angle, radians, below which the tangent vector the other way round is not needed.
SMALLEST_TURN = 0.01


@dataclass(frozen=True)
class SO3:
    """Rotations as unit quaternions (w, x, y, z); `q` and `-q` are the same point.

    Attributes:
        axis: name of the axis of a point where it is stored; empty: it is named after the variable.
    """

    axis: str = ""

    shape = (4,)
    dimension = 3
    tangent_labels = ("rx", "ry", "rz")
    tangent_units = ("rad", "rad", "rad")
    blocks = (0, 0, 0, 0)

    @property
    def axes(self) -> tuple[Axis, ...]:
        """The entries of the quaternion."""
        return (Axis(self.axis, rigid.NAMES[3:], ("1",) * 4),)

    def local(self, x: Points, y: Points) -> Vectors:
        """Return the rotation vector of `x⁻¹ y`, radians."""
        return rotations.logarithm(rotations.multiply(rotations.conjugate(x), y))

    def retract(self, x: Points, v: Vectors) -> Points:
        """Return `x exp(v)`, of length one."""
        return rotations.normalised(rotations.multiply(x, rotations.exponential(v)))

    def coordinates(self, centre: Points, y: Points) -> Vectors:
        """Return `local(centre, y)`."""
        return self.local(centre, y)

    def mean(self, weights: Weights, points: Points) -> Points:
        """Return the intrinsic mean, by Newton steps from the extrinsic mean (Markley et al. 2007); draws must not spread over the whole group."""
        xp = namespace(weights, points)
        outer = xp.einsum("...s,...si,...sj->...ij", weights, points, points)
        mean = rotations.canonical(xp.linalg.eigh(outer)[1][..., -1])
        for _ in range(MEAN_STEPS):
            mean = self.retract(mean, xp.einsum("...s,...sk->...k", weights, self.local(mean[..., None, :], points)))
        return mean

    def distance(self, x: Points, y: Points) -> Numbers:
        """Return the angle between the rotations, radians."""
        return rotations.angle(rotations.multiply(rotations.conjugate(x), y))

    def log_measure(self, v: Vectors) -> Numbers:
        """Return the log-Jacobian of the exponential map."""
        return rotations.log_jacobian(v)

    def images(self, v: Vectors) -> Vectors:
        """Return v, and the rotation the other way round. At the zero vector this rotation has no axis; its vector is then far away."""
        xp = namespace(v)
        angle = length(v)[..., None]
        # Close to zero, the other way round has almost no density, and no finite Jacobian.
        turned = angle > SMALLEST_TURN
        image = xp.where(turned, v * (1 - TURN / xp.where(turned, angle, 1.0)), 1.5 * TURN)
        return xp.stack([v, image], axis=-2)


@dataclass(frozen=True)
class SE3:
    """Rigid transforms as 7-vectors (`geometry.rigid`).

    Attributes:
        axis: name of the axis of a point where it is stored; empty: it is named after the variable.
    """

    axis: str = ""

    shape = (7,)
    dimension = 6
    tangent_labels = ("x", "y", "z", *SO3.tangent_labels)
    tangent_units = ("m", "m", "m", *SO3.tangent_units)
    blocks = (0,) * 7

    @property
    def axes(self) -> tuple[Axis, ...]:
        """The entries of the 7-vector."""
        return (Axis(self.axis, rigid.NAMES, ("m",) * 3 + ("1",) * 4),)

    def local(self, x: Points, y: Points) -> Vectors:
        """Return the difference of the origins, metres, and the rotation vector, radians."""
        return joined(y[..., :3] - x[..., :3], SO3().local(x[..., 3:], y[..., 3:]))

    def retract(self, x: Points, v: Vectors) -> Points:
        """Return the placement to which a tangent vector leads."""
        return joined(x[..., :3] + v[..., :3], SO3().retract(x[..., 3:], v[..., 3:]))

    def coordinates(self, centre: Points, y: Points) -> Vectors:
        """Return the origin, metres, and the rotation vector from the centre, radians."""
        return joined(y[..., :3], SO3().local(centre[..., 3:], y[..., 3:]))

    def mean(self, weights: Weights, points: Points) -> Points:
        """Return the mean of the origins and the intrinsic mean of the rotations."""
        origin = namespace(weights, points).einsum("...s,...sk->...k", weights, points[..., :3])
        return joined(origin, SO3().mean(weights, points[..., 3:]))

    def distance(self, x: Points, y: Points) -> Numbers:
        """Return the root of metres² + radians²."""
        return length(self.local(x, y))

    def log_measure(self, v: Vectors) -> Numbers:
        """Return the log-Jacobian of the rotation's exponential map."""
        return rotations.log_jacobian(v[..., 3:])

    def images(self, v: Vectors) -> Vectors:
        """Return v, and the same with the rotation the other way round."""
        turned = SO3().images(v[..., 3:])
        return joined(v[..., None, :3] + 0 * turned, turned)
