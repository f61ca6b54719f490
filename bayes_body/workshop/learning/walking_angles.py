r"""Learn a walking cycle in joint angles (Sidenbladh, Black & Fleet 2000, 5) from captured walks of several people.

Each walk is retargeted to a body and cut into strides, from one strike of the left heel to the next. A stride is the Fourier series of every joint
angle, the logarithm of its duration and that of its length (`bayes_body.model.dynamics.angle_cycle`). The modes are the singular vectors of the
centred strides, enough to explain 95 % of the variance. Distances between strides are root mean squares of angles over the stride, in radians, and of
the two logarithms. All strides of one person together have the same weight as those of any other.

Mirrored strides are not used: they explain the walks of other people no better.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from bayes_body.base.errors import input_error
from bayes_body.initial.retarget import retarget
from bayes_body.initial.retarget.fit import filled
from bayes_body.model.body.branches import TURN, nearest_branch, settled
from bayes_body.model.body.build import build_body
from bayes_body.model.body.schema import BodySchema
from bayes_body.model.body.skeleton import Topology
from bayes_body.model.body.solids import Body
from bayes_body.model.dynamics.angle_cycle import AngleCycle
from bayes_body.recording.readers.mocap import landmarks, resample
from bayes_body.recording.readers.mocap.motion import Motion
from bayes_body.workshop.learning.gait import GRAVITY, TERMS, fault_of_walk, heel_strikes, height, leg_length, points_of, series_of, terms

EXPLAINED = 0.95
# Frames a second of the angles. Eight harmonics of the fastest stride (0.6 s) need 27.
FPS = 60.0
ROOT = 6


class AngleWalk(NamedTuple):
    """A captured walk: its name, the person, the joint angles without the root's (radians), its landmarks (metres, z up), frames per second."""

    name: str
    subject: str
    angles: Float[np.ndarray, "frame dof"]
    points: Mapping[str, np.ndarray]
    fps: float


class AngleStride(NamedTuple):
    """One stride: the person, and its row (Fourier terms of each dof, then the two logarithms of the pace)."""

    subject: str
    row: Float[np.ndarray, " entry"]


@dataclass(frozen=True)
class LearnedAngles:
    """A cycle, its number of strides, and the walks that they are from."""

    cycle: AngleCycle
    strides: int
    walks: tuple[str, ...]


def unusable(name: str, motion: Motion) -> str | None:
    """Return why strides cannot be learned from a motion, or None. This is known before the motion is retargeted, which takes long."""
    points = landmarks(motion)
    fault = fault_of_walk(name, points, motion.fps)
    if fault is None and len(strikes_of(points, motion.fps)) < 2:
        return f"{name}: no whole stride: left out"
    return fault


def angles_of_walk(name: str, subject: str, motion: Motion, body: str, schema: BodySchema) -> AngleWalk:
    """Retarget a captured walk to a body. Angles that its points leave open are those nearest to rest.

    Raises:
        InputError: the motion lacks points of the body, or the body's first joint has not six dofs.
    """
    motion = resample(motion, FPS)
    return AngleWalk(name, subject, retargeted(motion, body, schema)[:, ROOT:], landmarks(motion), FPS)


def retargeted(motion: Motion, body: str, schema: BodySchema) -> Float[np.ndarray, "frame dof"]:
    """Return the dofs of a body that follows a motion, radians and metres. Angles that its points leave open are those nearest to rest.

    Raises:
        InputError: the motion lacks points of the body, or the body's first joint has not six dofs.
    """
    start = build_body(body, schema)
    if len(start.skeleton.topology.motions[0]) != ROOT:
        problem = f"{len(start.skeleton.topology.motions[0])} dofs of its first joint"
        raise input_error(f"body '{body}'", problem, "6: position and orientation in the world", "name another body")
    fit = retarget(start, motion, schema=schema)
    return settled_frames(fit.body, fit.angles)


def settled_frames(body: Body, angles: Float[np.ndarray, "frame dof"]) -> Float[np.ndarray, "frame dof"]:
    """Return for each frame the angles nearest to rest that place the body's markers alike, radians and metres."""
    # Padded, so that walks of similar length share a compiled program.
    frames = jnp.asarray(filled(angles, 0.0), body.lengths.dtype)
    return np.asarray(_all_settled(body, frames), float)[: len(angles)]


@jax.jit
def _all_settled(body: Body, frames: Float[Array, "frame dof"]) -> Float[Array, "frame dof"]:
    return jax.lax.map(lambda pose: settled(body, pose), frames, batch_size=60)


def learn_angles(walks: Sequence[AngleWalk], body: str, schema: BodySchema) -> LearnedAngles:
    """Learn the cycle from walks of one or more people.

    Raises:
        InputError: fewer than two strides.
    """
    skeleton = build_body(body, schema).skeleton
    limits = tuple(np.asarray(side, float)[ROOT:] for side in (skeleton.low, skeleton.high))
    alike_angles = alike([walk.angles for walk in walks], skeleton.topology, *limits)
    walks = [walk._replace(angles=angles) for walk, angles in zip(walks, alike_angles, strict=True)]
    strides = [AngleStride(walk.subject, row) for walk in walks for row in _rows(walk)]
    if len(strides) < 2:
        raise input_error("the walks", f"{len(strides)} strides", "at least 2 whole strides", "give straight walks of at least two steps each")
    rows, weights = np.stack([stride.row for stride in strides]), _weights([stride.subject for stride in strides])
    mean, modes, shares = _components(rows, weights)
    count = int(np.searchsorted(shares, EXPLAINED)) + 1
    names = skeleton.topology.dof_names[ROOT:]
    shape = (TERMS, len(names))
    cycle = AngleCycle(
        body,
        names,
        mean[:-2].reshape(shape),
        modes[:count, :-2].reshape(count, *shape),
        mean[-2:],
        modes[:count, -2:],
        _left_for_others(strides, count, shape),
        float(shares[count - 1]),
    )
    return LearnedAngles(cycle, len(strides), tuple(walk.name for walk in walks))


def near_reference(topology: Topology, angles: Float[np.ndarray, "frame dof"], reference: Float[np.ndarray, " dof"]) -> np.ndarray:
    """Return the angles of a walk (without the root's) by the solutions and turns that are nearest to a reference."""
    root = np.zeros(ROOT)
    dofs = np.concatenate([np.zeros((len(angles), ROOT)), angles], axis=1)
    branch = nearest_branch(topology, jnp.asarray(dofs.mean(axis=0)), jnp.asarray(np.concatenate([root, reference])))
    return np.asarray(branch.sign * dofs + np.asarray(branch.offset), float)[:, ROOT:]


def alike(walks: Sequence[Float[np.ndarray, "_ dof"]], topology: Topology, low: np.ndarray, high: np.ndarray) -> list[Float[np.ndarray, "_ dof"]]:
    """Return angles of walks (without the root's) with the solutions and turns of the first, then with full turns common to all.

    The common turns bring all of them to the middle of the limits `low` and `high`.
    """
    branches = [near_reference(topology, walk, walks[0].mean(axis=0)) for walk in walks]
    extremes = np.min([angles.min(axis=0) for angles in branches], axis=0) + np.max([angles.max(axis=0) for angles in branches], axis=0)
    middle = np.where(np.isfinite(low + high), (low + high) / 2, 0.0)
    turns = TURN * np.round((extremes / 2 - middle) / TURN)
    return [angles - turns for angles in branches]


def strikes_of(points: Mapping[str, np.ndarray], fps: float, side: str = "l") -> Int[np.ndarray, " strike"]:
    """Return the frames in which the heel of one side strikes the floor."""
    return heel_strikes(points, fps, height(points, points_of(points)), side)


def _rows(walk: AngleWalk) -> list[Float[np.ndarray, " entry"]]:
    leg, pelvis = leg_length(walk.points), walk.points["pelvis"][:, :2]
    rows = []
    for first, last in pairwise(strikes_of(walk.points, walk.fps).tolist()):
        duration = (last - first) / walk.fps / np.sqrt(leg / GRAVITY)
        length = np.linalg.norm(pelvis[last] - pelvis[first]) / leg
        rows.append(np.concatenate([series_of(walk.angles[first : last + 1]).ravel(), np.log([duration, length])]))
    return rows


def _weights(subjects: Sequence[str]) -> Float[np.ndarray, " stride"]:
    """Return weights that sum to 1, with an equal sum for each person."""
    counts = np.array([subjects.count(subject) for subject in subjects])
    return 1 / (counts * len(set(subjects)))


def _components(rows: Float[np.ndarray, "stride entry"], weights: Float[np.ndarray, " stride"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the mean row, the modes (for one standard deviation), and the share of the variance that the first modes explain."""
    # The mean square of a harmonic over a cycle is half that of its amplitude.
    dofs = (rows.shape[1] - 2) // TERMS
    metric = np.concatenate([np.repeat(np.where(np.arange(TERMS) == 0, 1.0, np.sqrt(0.5)), dofs), [1.0, 1.0]])
    mean = weights @ rows
    _, sizes, directions = np.linalg.svd(np.sqrt(weights)[:, None] * (rows - mean) * metric, full_matrices=False)
    # A mode and its negative are equivalent: choose the one that lengthens the stride.
    signs = np.where(directions[:, -1] < 0, -1.0, 1.0)
    return mean, (signs * sizes)[:, None] * directions / metric, np.cumsum(sizes**2) / max(float((sizes**2).sum()), 1e-12)


def _left_for_others(strides: Sequence[AngleStride], count: int, shape: tuple[int, int]) -> Float[np.ndarray, " dof"]:
    """Return the root mean square of each dof that `count` modes of the other people leave of a person's strides; with one person, of their own."""
    people = sorted({stride.subject for stride in strides})
    squares = []
    for person in people:
        person_strides = [stride for stride in strides if stride.subject == person]
        other_strides = [stride for stride in strides if stride.subject != person] or person_strides
        mean, modes, _ = _components(np.stack([s.row for s in other_strides]), _weights([s.subject for s in other_strides]))
        T = terms(np.linspace(0, 1, 100, endpoint=False))
        basis = np.stack([(T @ mode[:-2].reshape(shape)).ravel() for mode in modes[:count]], axis=1)
        deviations = np.stack([(T @ (stride.row - mean)[:-2].reshape(shape)).ravel() for stride in person_strides], axis=1)
        # A coefficient of an unlikely size is no explanation: ridge regression with the variance that a typical residual has.
        residual = deviations - basis @ np.linalg.solve(basis.T @ basis + np.eye(len(basis.T)) * deviations.var(), basis.T @ deviations)
        squares.append((residual.reshape(len(T), shape[1], -1) ** 2).mean(axis=(0, 2)))
    return np.sqrt(np.mean(squares, axis=0))
