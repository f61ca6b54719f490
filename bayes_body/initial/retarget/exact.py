r"""Exact decomposition of a motion whose skeleton is the body's: a joint's transform as its dofs, $D_j = P_j^{-1} T_{parent(j)}^{-1} T_j$.

Nothing is fitted. The result is None if a joint is missing, has another parent, has an offset that the body does not have, or turns in a way that
the body's joint cannot. In these cases the body's angles would not be the motion's.

The joints' axes in a file are either those of the body's joints or, as in bvh, axes that all have the same directions in the body's zero pose. In the
second case, with $R^0_j$ the joint's rotation in the zero pose and S the rotation of the file's axes relative to the world's,
$R_j = R^{file}_j\, S\, R^0_j$.

A joint's rotation is decomposed into its angles in order, $D = R_{a_1}(\pm s_1) R_{a_2}(\pm s_2) R_{a_3}(\pm s_3)$, and a remaining rotation.
Three angles, with different axes for neighbours, give every rotation in two ways. The second solution is $(s_1 + \pi, \pi - s_2, s_3 + \pi)$ if all
axes differ, and $(s_1 + \pi, -s_2, s_3 + \pi)$ if the first axis is also the third (Diebel 2006, Representing attitude, 5.6). Fewer angles give only
some rotations.
"""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

from bayes_body.base.config import FAST_COMPILE
from bayes_body.model.body.kinematics import forward_kinematics
from bayes_body.model.body.lengths import Scaling, scaling
from bayes_body.model.body.schema import BodySchema
from bayes_body.model.body.skeleton import Motion as Dof
from bayes_body.model.body.skeleton import Skeleton
from bayes_body.model.body.solids import Body
from bayes_body.recording.readers.mocap.motion import Motion

FULL = 2 * np.pi


class Angles(NamedTuple):
    """Angles of one joint over time, radians, and the remaining rotation that they do not reproduce in each frame, radians."""

    values: Float[np.ndarray, "frame turn"]
    residual: Float[np.ndarray, " frame"]


def angles_of(
    rotations: Float[np.ndarray, "frame 3 3"],
    axes: Sequence[int],
    signs: Sequence[int],
    low: Float[np.ndarray, " turn"],
    high: Float[np.ndarray, " turn"],
) -> Angles | None:
    """Return the angles of every frame, without jumps, and within their limits if possible; None for axes that cannot be decomposed.

    Args:
        rotations: rotations of the joint relative to its rest.
        axes: 0, 1 or 2 for each angle, in order.
        signs: 1 or -1 for each angle.
        low: lower limits, radians, or infinite.
        high: upper limits, radians, or infinite.
    """
    count = len(axes)
    if not count:
        return Angles(np.zeros((len(rotations), 0)), Rotation.from_matrix(rotations).magnitude())
    if count > 3 or any(a == b for a, b in pairwise(axes)):
        return None
    solutions = _solve_angles(rotations, axes) * np.asarray(signs)
    chains = [_chained(solutions, _into(solutions[0, branch], low, high)) for branch in range(2)]
    residuals = [_residual(rotations, chain, axes, signs) for chain in chains]
    chosen = min(range(2), key=lambda k: (residuals[k].max() > residuals[1 - k].max() + 1e-9, *_cost(chains[k], low, high)))
    return Angles(chains[chosen], residuals[chosen])


def _solve_angles(rotations: Float[np.ndarray, "frame 3 3"], axes: Sequence[int]) -> Float[np.ndarray, "frame 2 turn"]:
    """Return the two solutions for the angles of every rotation, cut to the number of axes."""
    unused_axes = [axis for axis in range(3) if axis not in axes]
    order = [*axes, *unused_axes][:3]
    with warnings.catch_warnings():
        # In gimbal lock only the sum or difference of the outer angles is determined: scipy sets the last one to 0 and warns.
        warnings.simplefilter("ignore", UserWarning)
        first_solution = Rotation.from_matrix(rotations).as_euler("".join("XYZ"[axis] for axis in order))
    middle = -first_solution[:, 1] if order[0] == order[2] else np.pi - first_solution[:, 1]
    second_solution = np.stack([first_solution[:, 0] + np.pi, middle, first_solution[:, 2] + np.pi], axis=1)
    return np.stack([first_solution, second_solution], axis=1)[..., : len(axes)]


def _chained(solutions: Float[np.ndarray, "frame 2 turn"], start: Float[np.ndarray, " turn"]) -> Float[np.ndarray, "frame turn"]:
    """Return one solution for each frame, starting near `start`: the solution that is nearer to the frame before, up to full turns."""
    chain = np.empty((len(solutions), solutions.shape[-1]))
    previous = start
    for t, two in enumerate(solutions):
        candidates = two - FULL * np.round((two - previous) / FULL)
        previous = chain[t] = candidates[np.abs(candidates - previous).sum(axis=1).argmin()]
    return chain


def _into(values: Float[np.ndarray, " turn"], low: Float[np.ndarray, " turn"], high: Float[np.ndarray, " turn"]) -> Float[np.ndarray, " turn"]:
    """Return the same angles, at most half a turn from the middle of their limits."""
    bounded = np.isfinite(low) & np.isfinite(high)
    middle = np.where(bounded, (np.where(bounded, low, 0.0) + np.where(bounded, high, 0.0)) / 2, 0.0)
    return values - FULL * np.round((values - middle) / FULL)


def _cost(chain: Float[np.ndarray, "frame turn"], low: Float[np.ndarray, " turn"], high: Float[np.ndarray, " turn"]) -> tuple[int, float]:
    """Return the number of angles outside their limits, then the sum of all angles' sizes."""
    return int(((chain < low - 1e-6) | (chain > high + 1e-6)).sum()), float(np.abs(chain).sum())


def _residual(
    rotations: Float[np.ndarray, "frame 3 3"], values: Float[np.ndarray, "frame turn"], axes: Sequence[int], signs: Sequence[int]
) -> np.ndarray:
    composed = Rotation.from_euler("".join("XYZ"[axis] for axis in axes), values * np.asarray(signs))
    return (composed.inv() * Rotation.from_matrix(rotations)).magnitude()


# Differences up to these count as zero: of offsets in metres, of rotations in radians.
OFFSET_M, ANGLE = 1e-3, 1e-5


class Placed(NamedTuple):
    """The motion's rotation, with the body's axes, and position, metres, of each of the body's joints in the world."""

    rotations: Float[np.ndarray, "frame joint 3 3"]
    places: Float[np.ndarray, "frame joint 3"]


class Exact(NamedTuple):
    """The angles in every frame, the joints in the world, how the body changes with its lengths (None if they are kept), and the lengths' factors."""

    angles: Float[np.ndarray, "frame dof"]
    placed: Placed
    change: Scaling | None
    factors: Float[np.ndarray, " length"]

    @property
    def lengths_m(self) -> list[float]:
        """The lengths, metres, in the order of the body's file; empty if they are kept."""
        return [] if self.change is None else (np.asarray(self.change.values, float) * self.factors).tolist()


def decompose(body: Body, motion: Motion, joints: Mapping[str, str], schema: BodySchema | None) -> Exact | None:
    """Return the motion's own angles; None if its skeleton is not the body's.

    Args:
        body: the body whose dofs are returned.
        motion: a motion with rotations and without gaps.
        joints: the motion's names of the body's joints, where they differ.
        schema: the body's schema if its lengths are adapted to the motion; None keeps the lengths.
    """
    placements = list(_placements(body.skeleton, motion, joints))
    change = scaling(body, schema) if schema is not None and placements else None
    decompositions = (_decomposed(body, placed, change) for placed in placements)
    return next((exact for exact in decompositions if exact is not None), None)


def carried(body: Body, placed: Placed) -> Float[np.ndarray, "frame marker 3"]:
    """Return the positions of the body's markers, attached to the motion's joints, metres."""
    joints = list(body.markers.joints)
    return placed.places[:, joints] + np.einsum("fmab,mb->fma", placed.rotations[:, joints], np.asarray(body.markers.offsets, float))


def with_ends(body: Body, exact: Exact, points: Float[np.ndarray, "frame marker 3"], change: Scaling) -> Exact:
    """Estimate the lengths that no joint's offset depends on, such as a forearm's, from the motion's points (metres, NaN where unknown)."""
    joints, markers = np.asarray(change.contributions.joints, float), np.asarray(change.contributions.markers, float)
    free = ~joints.any(axis=(1, 2))
    is_measured = np.isfinite(points).all(axis=(0, 2))
    marker_joints = np.array(body.markers.joints)[is_measured]
    marker_offsets = np.einsum(
        "fmba,fmb->fma", exact.placed.rotations[:, marker_joints], points[:, is_measured] - exact.placed.places[:, marker_joints]
    ).mean(axis=0)
    missing = marker_offsets - np.asarray(body.markers.offsets, float)[is_measured] - np.tensordot(exact.factors - 1, markers[:, is_measured], 1)
    growth = np.zeros(len(free))
    growth[free] = np.linalg.lstsq(markers[free][:, is_measured].reshape(int(free.sum()), -1).T, missing.ravel(), rcond=None)[0]
    return exact._replace(factors=exact.factors + growth)


def _decomposed(body: Body, placed: Placed, change: Scaling | None) -> Exact | None:
    frames = _in_parents(body.skeleton, placed)
    factors, offsets = _offsets(body, frames, change)
    angles = np.zeros((len(placed.places), len(body.dof_names)))
    for j, dofs in enumerate(body.skeleton.topology.motions):
        preset = np.asarray(body.skeleton.presets[j], float)
        taken = _taken_apart(body.skeleton, dofs, preset.T @ frames.rotations[:, j], (frames.places[:, j] - offsets[j]) @ preset)
        if taken is None:
            return None
        angles[:, [dof.dof for dof in dofs]] = taken
    return Exact(angles, placed, change, factors)


def _placements(skeleton: Skeleton, motion: Motion, joints: Mapping[str, str]) -> Iterator[Placed]:
    """Yield the body's joints for each possible convention of the file's axes; nothing if the trees differ."""
    topology, R = skeleton.topology, motion.rotations
    names = [joints.get(name, name) for name in topology.joint_names]
    if R is None or not len(R) or any(name not in motion.joints for name in names):
        return
    joint_indices = [motion.joints.index(name) for name in names]
    hang = (motion.parents[j] == (-1 if parent < 0 else joint_indices[parent]) for j, parent in zip(joint_indices, topology.parents, strict=True))
    rotations, places = R[:, joint_indices], motion.positions_m[:, joint_indices]
    if not all(hang) or not (np.isfinite(rotations).all() and np.isfinite(places).all()):
        return
    yield Placed(rotations, places)
    at_zero = np.asarray(_at_zero(skeleton), float)
    for turn in range(3):
        yield Placed(rotations @ np.roll(np.eye(3), turn, axis=0) @ at_zero, places)


@partial(jax.jit, compiler_options=FAST_COMPILE)
def _at_zero(skeleton: Skeleton) -> Float[Array, "joint 3 3"]:
    """Return the joints' rotations in the zero pose."""
    return forward_kinematics(skeleton, jnp.zeros(len(skeleton.topology.dof_names), skeleton.offsets.dtype)).rotation


def _in_parents(skeleton: Skeleton, placed: Placed) -> Placed:
    """Return every joint in its parent's frame."""
    R, p = placed
    rotations, places = R.copy(), p.copy()
    for j, parent in enumerate(skeleton.topology.parents):
        if parent >= 0:
            rotations[:, j] = np.swapaxes(R[:, parent], 1, 2) @ R[:, j]
            places[:, j] = np.einsum("fba,fb->fa", R[:, parent], p[:, j] - p[:, parent])
    return Placed(rotations, places)


def _offsets(body: Body, frames: Placed, change: Scaling | None) -> tuple[Float[np.ndarray, " length"], Float[np.ndarray, "joint 3"]]:
    """Return the factors of the body's lengths that best give the motion's offsets, and the offsets with these lengths, metres."""
    offsets = np.asarray(body.skeleton.offsets, float)
    if change is None:
        return np.zeros(0), offsets
    contributions = np.asarray(change.contributions.joints, float)
    fixed_joints = [j for j, dofs in enumerate(body.skeleton.topology.motions) if not any(dof.is_shift for dof in dofs)]
    missing = (frames.places.mean(axis=0) - offsets)[fixed_joints].ravel()
    growth = np.linalg.lstsq(contributions[:, fixed_joints].reshape(len(contributions), -1).T, missing, rcond=None)[0]
    return 1 + growth, offsets + np.tensordot(growth, contributions, 1)


def _taken_apart(
    skeleton: Skeleton, dofs: Sequence[Dof], rotation: Float[np.ndarray, "frame 3 3"], shift: Float[np.ndarray, "frame 3"]
) -> Float[np.ndarray, "frame turn"] | None:
    """Return the joint's dofs in order; None if they do not reproduce its rotation and shift within the tolerances."""
    turns = [dof for dof in dofs if not dof.is_shift]
    low, high = (np.asarray(side, float)[[dof.dof for dof in turns]] for side in (skeleton.low, skeleton.high))
    angles = angles_of(rotation, [dof.axis for dof in turns], [dof.sign for dof in turns], low, high)
    if angles is None or angles.residual.max() > ANGLE:
        return None
    values, directions = np.zeros((len(rotation), len(dofs))), []
    turned, k = np.broadcast_to(np.eye(3), rotation.shape), 0
    for i, dof in enumerate(dofs):
        if dof.is_shift:
            directions.append((i, dof.sign * turned[:, :, dof.axis]))
        else:
            values[:, i] = angles.values[:, k]
            turned, k = turned @ _turn(dof.axis, dof.sign * values[:, i]), k + 1
    if directions:
        A = np.stack([direction for _, direction in directions], axis=2)
        shifts = np.einsum("fsa,fa->fs", np.linalg.pinv(A), shift)
        shift = shift - np.einsum("fas,fs->fa", A, shifts)
        values[:, [i for i, _ in directions]] = shifts
    return values if np.linalg.norm(shift, axis=1).max() <= OFFSET_M else None


def _turn(axis: int, angle: Float[np.ndarray, " frame"]) -> Float[np.ndarray, "frame 3 3"]:
    R = np.zeros((len(angle), 3, 3))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R[:, axis, axis] = 1
    R[:, i, i] = R[:, j, j] = np.cos(angle)
    R[:, j, i] = np.sin(angle)
    R[:, i, j] = -R[:, j, i]
    return R
