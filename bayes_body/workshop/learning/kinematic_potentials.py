r"""Learn the kinematic potentials of a loose-limbed body (Sigal et al. 2011, (5), (6)) from captured motion of several people.

Each motion is retargeted to the body. Of all angles that place the markers alike, those nearest to rest are used, as for a walking cycle. They give
the pose of each part in its parent's frame, in the body with the person's own lengths. The position is relative to where the joint is when all angles
are 0, so that people of different size agree. An equal number of frames of each motion is used. All motions of one person together have the same
weight as those of any other person.

A Gaussian mixture is fitted to the relative poses, in the tangent spaces at the components' own means (Sigal et al. 2011, (6)), by EM,

$$r_{nm} \propto \delta_m\, g_m(Y_n), \qquad \bar Y_m = \arg\min_Y \sum_n w_n r_{nm}\, d(Y, Y_n)^2, \qquad
\Sigma_m = \frac{\sum_n w_n r_{nm}\, \xi_{nm} \xi_{nm}^T}{\sum_n w_n r_{nm}}, \quad \xi_{nm} = \mathrm{Exp}^{-1}(\bar Y_m^{-1} Y_n)$$

for the blocks of position and rotation separately. EM starts from the clusters of scikit-learn's `KMeans`. Its steps are written out here, because
scikit-learn's `GaussianMixture` has no block-diagonal covariances, no weights of draws, and one vector space for all components. The tangent space
at one point distorts rotations that are a radian or more away.

The intrinsic mean and this covariance maximise the likelihood up to the curvature of the rotations within a component, and up to the floors. The
iterate with the largest likelihood is returned.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.special import logsumexp
from sklearn.cluster import KMeans

from bayes_body.base.errors import input_error
from bayes_body.base.geometry import rigid, rotations
from bayes_body.density.chart import relative_to_parents
from bayes_body.density.spaces import SE3, SO3
from bayes_body.initial.retarget import retarget
from bayes_body.model.body.build import build_body
from bayes_body.model.body.placed_body import loosened
from bayes_body.model.body.placement import ByParts
from bayes_body.model.body.schema import BodySchema
from bayes_body.model.body.solids import Body
from bayes_body.model.potentials.joint_mixture import JointMixtures, log_of_components, mixture
from bayes_body.recording.readers.mocap import resample
from bayes_body.recording.readers.mocap.motion import Motion
from bayes_body.workshop.learning.walking_angles import FPS, settled_frames

ITERATIONS, ENOUGH = 300, 1e-5
STARTS = 4
# The share of each draw that all clusters have in common at the start, so that none is empty.
COMMON = 0.1


class Fitted(NamedTuple):
    """A mixture: mean relative poses, covariances of position (metres²) and rotation (radians²), weights, and the log-likelihood of a draw, nats."""

    mean: Float[np.ndarray, "component 7"]
    covariance: Float[np.ndarray, "component 2 3 3"]
    weight: Float[np.ndarray, " component"]
    log_likelihood: float


class Floors(NamedTuple):
    """No standard deviation along any axis is smaller than these: metres of position, radians of rotation."""

    position: float
    rotation: float


def fit_mixture(poses: Float[np.ndarray, "draw 7"], weights: Float[np.ndarray, " draw"], components: int, floors: Floors) -> Fitted:
    """Return the best of several fits.

    Args:
        poses: relative poses.
        weights: of the poses, of sum 1.
        components: number of components.
        floors: smallest standard deviations.
    """
    centre = SE3().mean(weights, poses)
    flat = SE3().local(centre, poses)
    # More clusters than different poses would be empty.
    clusters = min(components, len(np.unique(flat, axis=0)))
    starts = STARTS if clusters > 1 else 1
    labels = [KMeans(clusters, random_state=seed).fit(flat, sample_weight=weights).labels_ for seed in range(starts)]
    fits = [_climb(poses, weights, (1 - COMMON) * np.eye(components)[clustering] + COMMON / components, floors) for clustering in labels]
    return max(fits, key=lambda fit: fit.log_likelihood)


def log_density(fitted: Fitted, poses: Float[np.ndarray, "draw 7"]) -> Float[np.ndarray, " draw"]:
    """Return the log-density of relative poses under a mixture, nats; with respect to metres³ and Haar measure."""
    return np.asarray(logsumexp(log_of_components(mixture(*fitted[:3]), poses), axis=1))


def _climb(poses: np.ndarray, weights: np.ndarray, shares: Float[np.ndarray, "draw component"], floors: Floors) -> Fitted:
    best, previous_log_likelihood = None, -np.inf
    for _ in range(ITERATIONS):
        mean, covariance, weight = _maximised(poses, weights, shares, floors)
        log_densities = log_of_components(mixture(mean, covariance, weight), poses)
        total = logsumexp(log_densities, axis=1, keepdims=True)
        log_likelihood = float(weights @ total[:, 0])
        if best is None or log_likelihood > best.log_likelihood:
            best = Fitted(mean, covariance, weight, log_likelihood)
        if log_likelihood - previous_log_likelihood < ENOUGH:
            break
        previous_log_likelihood, shares = log_likelihood, np.exp(log_densities - total)
    assert best is not None
    return best


def _maximised(poses: np.ndarray, weights: np.ndarray, shares: np.ndarray, floors: Floors) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    responsibilities = weights[:, None] * shares
    # A component that loses all its draws keeps a weight above 0, whose logarithm is finite.
    weight = np.maximum(responsibilities.sum(axis=0), 1e-12)
    responsibilities = (responsibilities / responsibilities.sum(axis=0)).T
    mean = np.asarray(rigid.rigid(responsibilities @ poses[:, :3], rotations.canonical(SO3().mean(responsibilities, poses[:, 3:]))))
    steps = rigid.relative(mean[:, None], poses[None])
    xi = np.stack([steps[..., :3], rotations.logarithm(steps[..., 3:])], axis=1)
    covariance = np.einsum("mn,mbni,mbnj->mbij", responsibilities, xi, xi)
    return mean, _floored(covariance, floors), weight / weight.sum()


def _floored(covariance: Float[np.ndarray, "component 2 3 3"], floors: Floors) -> Float[np.ndarray, "component 2 3 3"]:
    values, axes = np.linalg.eigh(covariance)
    values = np.maximum(values, np.square(floors)[:, None])
    return np.einsum("mbik,mbk,mbjk->mbij", axes, values, axes)


class JointPoses(NamedTuple):
    """Relative poses of one motion: its name, the person, and every joint's pose (see `JointMixtures.mean`) in some frames."""

    name: str
    subject: str
    poses: Float[np.ndarray, "frame joint 7"]


class HeldOut(NamedTuple):
    """Mean log-densities of other frames, nats, by person and joint."""

    subjects: tuple[str, ...]
    values: Float[np.ndarray, "subject joint"]


def joints_of(body: str, schema: BodySchema) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the child and the parent of every joint of a loose-limbed body.

    Raises:
        InputError: the body cannot be placed by its parts, or has only one.
    """
    placement = loosened(build_body(body, schema)).placement
    assert isinstance(placement, ByParts)
    joints = [(name, placement.names[parent]) for name, parent in zip(placement.names, placement.parents, strict=True) if parent >= 0]
    if not joints:
        raise input_error(f"body '{body}'", "one part", "at least two parts, with a joint between them", "name another body")
    return tuple(part for part, _ in joints), tuple(parent for _, parent in joints)


def joint_poses(name: str, subject: str, motion: Motion, body: str, schema: BodySchema, frames: int) -> JointPoses:
    """Return the relative poses of a captured motion, in so many frames at equal distances. A shorter motion repeats some.

    Raises:
        InputError: the motion lacks points of the body.
    """
    motion = resample(motion, FPS)
    fit = retarget(build_body(body, schema), motion, schema=schema)
    chosen = np.linspace(0, len(fit.angles) - 1, frames).round().astype(int)
    angles = settled_frames(fit.body, fit.angles[chosen])
    return JointPoses(name, subject, relative_poses(fit.body, angles))


def relative_poses(body: Body, angles: Float[np.ndarray, "frame dof"]) -> Float[np.ndarray, "frame joint 7"]:
    """Return the pose of every joint at these angles: the position from where it is at angles of 0, metres, and the rotation."""
    parts = np.asarray(_relative(loosened(body), jnp.asarray(np.concatenate([np.zeros_like(angles[:1]), angles]), body.lengths.dtype)), float)
    parts[1:, :, :3] -= parts[:1, :, :3]
    return parts[1:]


@jax.jit
def _relative(body: Body, angles: Float[Array, "frame dof"]) -> Float[Array, "frame joint 7"]:
    placement = body.placement
    assert isinstance(placement, ByParts)
    children = np.array([child for child, parent in enumerate(placement.parents) if parent >= 0])
    place = jax.vmap(lambda pose: relative_to_parents(jnp.asarray(placement.configuration(body.skeleton, pose)), placement.parents))
    return place(angles)[:, children]


def learn_joints(motions: Sequence[JointPoses], body: str, schema: BodySchema, components: int, floors: Floors) -> JointMixtures:
    """Learn a mixture of so many components for each joint.

    Raises:
        InputError: the body cannot be placed by its parts.
    """
    parts, parents = joints_of(body, schema)
    poses, weights = np.concatenate([motion.poses for motion in motions]), _weights(motions)
    fits = [fit_mixture(poses[:, joint], weights, components, floors) for joint in range(len(parts))]
    mean, covariance, weight = (np.stack(values) for values in list(zip(*fits, strict=True))[:3])
    return JointMixtures(body, parts, parents, mean, covariance, weight)


def held_out(joints: JointMixtures, motions: Sequence[JointPoses]) -> HeldOut:
    """Return the mean log-density of the frames of motions, with all motions of a person counted alike."""
    fits = [Fitted(*values, 0.0) for values in zip(joints.mean, joints.covariance, joints.weight, strict=True)]
    log_densities = np.array([[log_density(fit, motion.poses[:, joint]).mean() for joint, fit in enumerate(fits)] for motion in motions])
    subjects = np.array([motion.subject for motion in motions])
    people = tuple(dict.fromkeys(subjects.tolist()))
    return HeldOut(people, np.stack([log_densities[subjects == person].mean(axis=0) for person in people]))


def _weights(motions: Sequence[JointPoses]) -> Float[np.ndarray, " draw"]:
    """Return weights that sum to 1: equal for each person, and for each motion of a person."""
    subjects = [motion.subject for motion in motions]
    of_motion = [1 / (len(set(subjects)) * subjects.count(motion.subject) * len(motion.poses)) for motion in motions]
    return np.concatenate([np.full(len(motion.poses), weight) for motion, weight in zip(motions, of_motion, strict=True)])
