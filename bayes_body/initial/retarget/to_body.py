"""Retarget a captured motion to a body's joint angles, by exact decomposition or by a fit.

The result also has the distances of the body's markers from the captured points.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.base.config import FAST_COMPILE
from bayes_body.base.errors import InputError, input_error
from bayes_body.initial.fitting.points import factors, scaled
from bayes_body.initial.retarget.exact import Exact, carried, decompose, with_ends
from bayes_body.initial.retarget.fit import filled, fit_motion
from bayes_body.initial.retarget.problem import build_problem, places_of
from bayes_body.model.body.build import Shape, build_body
from bayes_body.model.body.kinematics import marker_positions
from bayes_body.model.body.schema import BodySchema
from bayes_body.model.body.solids import Body
from bayes_body.model.definition import load_body
from bayes_body.recording.readers.mocap.landmarks import landmarks
from bayes_body.recording.readers.mocap.motion import Motion


class Retargeted(NamedTuple):
    """A motion as the joint angles of a body.

    Attributes:
        angles: (frame, dof), radians and metres, in the order of `body.dof_names`.
        lengths_m: the body's lengths if they were fitted, else empty.
        residual_m: (frame, marker), the distance of each of the body's markers from the motion's point of that name; NaN where it has none. For an
            exact motion, the points are the markers as attached to the motion's joints, except at the ends of limbs.
        exact: whether the angles are the motion's own, from an exact decomposition, rather than a fit.
        body: the body with the fitted lengths.
        markers_m: (frame, marker, 3), the positions of the body's markers at these angles.
        remarks: sentences for the user.
    """

    angles: Float[np.ndarray, "frame dof"]
    lengths_m: Mapping[str, float]
    residual_m: Float[np.ndarray, "frame marker"]
    exact: bool
    body: Body
    markers_m: Float[np.ndarray, "frame marker 3"]
    remarks: tuple[str, ...] = ()

    @property
    def marker_names(self) -> tuple[str, ...]:
        """The names of the columns of `residual_m`."""
        return self.body.markers.names

    def residual(self, marker: str | None = None) -> "Residual":
        """Return a summary of the residuals of one marker, or of all."""
        columns = slice(None) if marker is None else [self.marker_names.index(marker)]
        return summed_up(self.residual_m[:, columns])


class Residual(NamedTuple):
    """Summary of distances in millimetres: mean, 95 % quantile and maximum; NaN without distances."""

    mean_mm: float
    most_mm: float
    max_mm: float


def summed_up(residual_m: Float[np.ndarray, "frame marker"]) -> Residual:
    """Return a summary of the distances; NaN values are ignored."""
    residual_mm = 1000 * residual_m[np.isfinite(residual_m)]
    if not residual_mm.size:
        return Residual(float("nan"), float("nan"), float("nan"))
    return Residual(float(residual_mm.mean()), float(np.percentile(residual_mm, 95)), float(residual_mm.max()))


# With fewer known points in the best frame, the pose would be arbitrary.
FEWEST = 4
# A dof that moves more than this between frames gets a remark: radians.
JUMP = 1.0

# Positions by name. `places_of` checks that all have the same number of frames.
type Landmarks = Mapping[str, np.ndarray]


def retarget(
    body: Body,
    motion: Motion | Landmarks,
    fps: float | None = None,
    fit_lengths: bool = True,
    schema: BodySchema | None = None,
    joints: Mapping[str, str] | None = None,
) -> Retargeted:
    """Return the motion as joint angles of the body.

    If the motion's skeleton is the body's, they are the motion's own angles. Otherwise they have the smallest misfit to its landmarks.

    Args:
        body: the body whose angles are returned.
        motion: a motion that was read from a file, or points by name, (frame, 3), metres, z up, NaN where unknown. Points that are not markers of the
            body are ignored.
        fps: frames a second; ignored for a `Motion`, which has its own rate.
        fit_lengths: whether the body's lengths are adapted to the person; False keeps them.
        schema: the body's schema, from which the effect of its lengths follows; by default that of the shipped body of that name.
        joints: the motion's names of the body's joints, where they differ.

    Raises:
        InputError: the motion has too few of the body's points, no frames, or no frame rate.
    """
    if fit_lengths and schema is None:
        schema = load_body(body.name)
    if not fit_lengths:
        schema = None
    if isinstance(motion, Motion):
        exact = decompose(body, motion, joints or {}, schema)
        if exact is not None:
            return _exact(body, motion, exact, schema)
        return _fitted(body, landmarks(motion), motion.fps, schema, motion.name)
    return _fitted(body, motion, fps, schema, "the landmarks")


def _exact(body: Body, motion: Motion, exact: Exact, schema: BodySchema | None) -> Retargeted:
    points, lengths = places_of(body, _points(motion)), {}
    if schema is not None and exact.change is not None:
        exact = with_ends(body, exact, points, exact.change) if len(points) else exact
        lengths = dict(zip(schema.lengths_of_height, exact.lengths_m, strict=True))
        body = _with_lengths(body, schema, lengths)
    places = carried(body, exact.placed)
    # Only markers at the ends of limbs use the motion's points. All others follow from its joints, because the points can differ in definition:
    # the middle of the motion's shoulders, for example, need not be the body's thorax.
    ends = [joint not in body.skeleton.topology.parents for joint in body.markers.joints]
    if len(points):
        places[:, ends] = np.where(np.isfinite(points[:, ends]), points[:, ends], places[:, ends])
    return _result(body, exact.angles, lengths, places, True)


def _points(motion: Motion) -> Landmarks:
    """Return the motion's landmarks; empty if they cannot be determined."""
    try:
        return landmarks(motion)
    except InputError:
        return {}


def _with_lengths(body: Body, schema: BodySchema, lengths: Mapping[str, float]) -> Body:
    """Return the body with these lengths; its radii and sections are kept."""
    scaled_body = build_body(body.name, schema, Shape(None, lengths))
    dtype = body.lengths.dtype
    skeleton = replace(body.skeleton, offsets=scaled_body.skeleton.offsets.astype(dtype))
    markers = replace(body.markers, offsets=scaled_body.markers.offsets.astype(dtype))
    return replace(body, skeleton=skeleton, markers=markers, offsets=scaled_body.offsets.astype(dtype), lengths=scaled_body.lengths.astype(dtype))


def _fitted(body: Body, points: Landmarks, fps: float | None, schema: BodySchema | None, name: str) -> Retargeted:
    if fps is None or not (math.isfinite(fps) and fps > 0):
        raise input_error(f"{name}: fps", str(fps), "frames a second, a finite number above 0", "give the rate of the capture")
    places = places_of(body, points)
    _check_enough(body, points, places, name)
    problem = build_problem(body, schema)
    solution = fit_motion(problem, places, fps)
    lengths = {}
    if schema is not None:
        values = np.asarray(problem.scaling.values * factors(problem.scaling, solution.z), float)
        lengths = dict(zip(schema.lengths_of_height, values.tolist(), strict=True))
    return _result(scaled(body, problem.scaling, solution.z), np.asarray(solution.poses, float), lengths, places, False)


def _check_enough(body: Body, points: Landmarks, places: Float[np.ndarray, "frame marker 3"], name: str) -> None:
    is_measured = np.isfinite(places).all(axis=-1)
    fewest = min(FEWEST, len(body.markers.names))
    if is_measured.size and is_measured.sum(axis=1).max() >= fewest:
        return
    shared = [marker for marker in body.markers.names if marker in points]
    problem = f"{', '.join(shared) or 'none'} of the body's points" if is_measured.size else "no frame"
    expected = f"a frame with at least {fewest} of {', '.join(body.markers.names)}"
    raise input_error(name, problem, expected, "name its points as the body does, or capture more of them")


def _result(
    body: Body, angles: Float[np.ndarray, "frame dof"], lengths: Mapping[str, float], places: Float[np.ndarray, "frame marker 3"], exact: bool
) -> Retargeted:
    markers = np.asarray(_markers(body, jnp.asarray(filled(angles, 0.0), body.lengths.dtype)), float)[: len(angles)]
    remarks = (*_outside(body, angles), *_jumps(body, angles))
    return Retargeted(angles, lengths, np.linalg.norm(markers - places, axis=-1), exact, body, markers, remarks)


@partial(jax.jit, compiler_options=FAST_COMPILE)
def _markers(body: Body, poses: Float[Array, "frame dof"]) -> Float[Array, "frame marker 3"]:
    return jax.vmap(marker_positions, (None, None, 0))(body.skeleton, body.markers, poses)


def _outside(body: Body, angles: Float[np.ndarray, "frame dof"]) -> Iterator[str]:
    low, high = np.asarray(body.skeleton.low, float), np.asarray(body.skeleton.high, float)
    for k in np.flatnonzero(((angles < low - 1e-6) | (angles > high + 1e-6)).any(axis=0)):
        frames = int(((angles[:, k] < low[k] - 1e-6) | (angles[:, k] > high[k] + 1e-6)).sum())
        yield f"{body.dof_names[k]} lies outside the body's limits in {frames} of {len(angles)} frames: no model of this body can reach these values"


def _jumps(body: Body, angles: Float[np.ndarray, "frame dof"]) -> Iterator[str]:
    angular = np.array(body.skeleton.topology.angular)
    steps = np.abs(np.diff(angles, axis=0))
    for k in np.flatnonzero(angular & (steps > JUMP).any(axis=0)) if len(steps) else ():
        frame, degrees = int(steps[:, k].argmax()) + 1, math.degrees(steps[:, k].max())
        yield f"{body.dof_names[k]} moves by {degrees:.0f} degrees at frame {frame}: check that frame before you trust the motion"
