r"""Estimate the apparent thickness of body parts, clothes included, from the silhouettes of the first frame.

Trousers are wider than a calf of average thickness. If the model leaves them out, they affect the silhouette term more than the pose does: at the
true pose they remain uncovered, and a pose with one leg beside the other explains the silhouette just as well (docs/decisions). The pose is kept
fixed, and the radii are the solution of

$$\min_r\ 1 - \frac1C \sum_c \frac{\sum_x m_c(x)\, s_c(x; r)}{\sum_x m_c + s_c - m_c s_c}
    + \frac{\lambda}{2} \sum_g \log^2 (r_g / \bar r_g),$$

The first two terms are one minus the overlap (IoU) of the silhouettes m with the body's projection s, which is a logistic function of the signed
distance to the body's outline (model/likelihood/outlines.py). The last term pulls the radii towards the body's own radii $\bar r$. Each kind of part
has one r for its base and one for its tip; left and right share them.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.base.config import FAST_COMPILE
from bayes_body.base.errors import input_error
from bayes_body.base.geometry.camera import Camera
from bayes_body.base.geometry.namespaces import device_array
from bayes_body.base.shapes import Pose, Scalar
from bayes_body.initial.fitting.fit import minimise
from bayes_body.model.body.solids import Body
from bayes_body.model.build import Model
from bayes_body.model.likelihood.outlines import outline_forms, signed_distance
from bayes_body.recording.observation.covered import uncovered
from bayes_body.recording.observation.frames import covered_of, near_bodies, read_frame
from bayes_body.recording.readers.camera_path import cameras_at
from bayes_body.recording.session.session import Session

# Columns and rows of the grid on which silhouettes are compared. It covers each silhouette with a margin of this fraction of its size on all sides.
GRID = (64, 96)
MARGIN = 0.25
# Softness of the projection's outline, steps of the grid.
SOFT = 0.25
# λ: about this value gives the largest overlap of the body with the silhouettes in later frames of simulated people (docs/decisions).
PULL = 0.2
STEPS = 100
RATE = 0.05
# With less overlap than this, the pose does not match the silhouettes, and no thickness helps.
LEAST_OVERLAP = 0.4
# The side of the squares of pixels in which the first body is drawn, to tell figures of other people from it.
SQUARE_PX = 4
WHERE = "session.toml: initial.fit_outline"


class Silhouettes(NamedTuple):
    """The silhouette in each camera that saw the person, on its grid.

    The grid's columns and rows are in pixels from the image's middle; `inside` is 1 where a grid point is foreground. `counted` is 0 where another
    person covers it; None where no camera sees other people.
    """

    columns: Float[Array, "camera column"]
    rows: Float[Array, "camera row"]
    inside: Float[Array, "camera row column"]
    counted: Float[Array, "camera row column"] | None = None


class Outline(NamedTuple):
    """The (base, tip) radii of each part, metres, by name; and the overlap (IoU) with the silhouettes before and after the fit."""

    radii_m: Mapping[str, tuple[float, float]]
    before: float
    after: float


def fit_outline(model: Model, session: Session) -> Outline:
    """Return the fitted outline of a model's body in the first frame; the model's initial state is the pose there.

    Parts on a joint without dofs, such as hands and feet, keep their radii: the pose cannot turn them to where they are in the image.

    Raises:
        InputError: the session has no silhouettes, or no camera shows one in the first frame.
    """
    placed = model.at(cameras_at(session, 0)) if session.moves else model
    cameras, silhouettes = _silhouettes(placed, session)
    rig = jax.tree.map(lambda leaf: np.asarray(leaf)[np.array(cameras)], placed.rig)
    groups = np.asarray(_groups(model.body), model.body.lengths.dtype)
    logs, start_overlap, overlap = _fit(model.body.by_angles, rig, model.first_pose, groups, silhouettes)
    if float(start_overlap) < LEAST_OVERLAP:
        return Outline({}, float(start_overlap), float(start_overlap))
    radii = np.asarray(_thick(model.body, groups, logs).outline_radii, float)
    names = model.body.topology.names
    return Outline({name: (float(base), float(tip)) for name, (base, tip) in zip(names, radii, strict=True)}, float(start_overlap), float(overlap))


def _silhouettes(placed: Model, session: Session) -> tuple[list[int], Silhouettes]:
    """Return the numbers of the cameras that show the person in the first frame, and their silhouettes."""
    frame = read_frame(session, 0)
    if session.segmentation.figures == "near_body" and frame.masks is not None:
        frame = near_bodies(frame, _first_bodies(placed, session))
    masks = frame.masks
    if masks is None:
        problem, remedy = "true, in a session without silhouettes", "set it to false, or give each [[camera]] its `masks` or a `background`"
        raise input_error(WHERE, problem, "silhouettes to fit to", remedy)
    visible = [None if mask is None else uncovered(mask, covered) for mask, covered in zip(masks, covered_of(frame), strict=True)]
    silhouettes = {c: np.asarray(mask) for c, mask in enumerate(visible) if mask is not None and mask.any()}
    if not silhouettes:
        raise input_error(
            WHERE, "true, but no camera shows a silhouette in the first frame", "one that does", "set it to false, or start at another frame"
        )
    grids = [_grid(mask, covered_of(frame)[c]) for c, mask in silhouettes.items()]
    arrays = [device_array(np.stack(arrays)) for arrays in zip(*grids, strict=True)]
    return list(silhouettes), Silhouettes(*(arrays if frame.covered is not None else arrays[:3]))


def _first_bodies(placed: Model, session: Session) -> list[np.ndarray]:
    """Return where the body in its first pose covers each camera's image, (row, column)."""
    masks = []
    for camera, view in enumerate(session.views):
        rig = jax.tree.map(lambda leaf, c=camera: np.asarray(leaf)[c : c + 1], placed.rig)
        # From the image's middle to the middles of squares.
        columns, rows = (np.arange(0, size, SQUARE_PX) + (SQUARE_PX - 1 - size) / 2 for size in view.camera.size_px)
        inside = np.asarray(_distance(placed.body.by_angles, rig, placed.first_pose, columns, rows)) > 0
        width, height = view.camera.size_px
        masks.append(inside.repeat(SQUARE_PX, axis=0).repeat(SQUARE_PX, axis=1)[:height, :width])
    return masks


@partial(jax.jit, compiler_options=FAST_COMPILE)
def _distance(body: Body, rig: Camera, pose: Pose, columns: Array, rows: Array) -> Array:
    """Return how far the points of a grid are inside of the body's projection to the only camera of a rig, (row, column), pixels."""
    return signed_distance(body.topology, outline_forms(body, rig, pose)[0], columns, rows)


def _grid(mask: np.ndarray, covered: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    axes = []
    for axis, count in zip((1, 0), GRID, strict=True):
        hit = np.flatnonzero(mask.any(axis=1 - axis))
        margin = MARGIN * (hit[-1] - hit[0] + 1)
        axes.append(np.linspace(max(hit[0] - margin, 0), min(hit[-1] + margin, mask.shape[axis] - 1), count))
    columns, rows = axes
    places = np.rint(rows).astype(int)[:, None], np.rint(columns).astype(int)
    counted = np.ones(GRID[::-1]) if covered is None else 1.0 - covered[places]
    return columns - mask.shape[1] / 2, rows - mask.shape[0] / 2, mask[places], counted


def _groups(body: Body) -> Float[np.ndarray, "group part 2"]:
    """Return an array that is 1 where the radius of a part's base or tip depends on a parameter."""
    topology, moves = body.topology, [bool(motions) for motions in body.skeleton.topology.motions]
    kinds = dict[tuple[str, int], np.ndarray]()
    for p, (name, joint) in enumerate(zip(topology.names, topology.joints, strict=True)):
        if moves[joint]:
            for end in (0, 1):
                # A sphere has one radius, at its base.
                key = name.removeprefix("l_").removeprefix("r_"), 0 if topology.is_sphere[p] else end
                kinds.setdefault(key, np.zeros((len(topology.names), 2)))[p, end] = 1.0
    return np.array(list(kinds.values())).reshape(-1, len(topology.names), 2)


@jax.jit
def _thick(body: Body, groups: Float[Array, "group part 2"], logs: Float[Array, " group"]) -> Body:
    return replace(body, outline_radii=body.outline_radii * jnp.exp(jnp.tensordot(logs, groups, 1)))


def _overlap(body: Body, rig: Camera, pose: Pose, silhouettes: Silhouettes) -> Scalar:
    """Return the mean IoU of the silhouettes and the body's projection."""

    def iou(forms: Array, columns: Array, rows: Array, inside: Array, counted: Array | None) -> Scalar:
        distance = signed_distance(body.topology, forms, columns, rows)
        covered = jax.nn.sigmoid(distance / (SOFT * (columns[1] - columns[0])))
        if counted is not None:
            covered = covered * counted
        intersection = jnp.sum(inside * covered)
        return intersection / (jnp.sum(inside) + jnp.sum(covered) - intersection)

    return jnp.mean(jax.vmap(iou)(outline_forms(body, rig, pose), *silhouettes))


@partial(jax.jit, compiler_options=FAST_COMPILE)
def _fit(
    body: Body, rig: Camera, pose: Pose, groups: Float[Array, "group part 2"], silhouettes: Silhouettes
) -> tuple[Float[Array, " group"], Scalar, Scalar]:
    """Return the logarithms of the radii's factors, and the overlap before and after the fit."""

    def loss(logs: Float[Array, " group"]) -> tuple[Scalar, Scalar]:
        overlap = _overlap(_thick(body, groups, logs), rig, pose, silhouettes)
        return 1 - overlap + 0.5 * PULL * jnp.sum(logs**2), overlap

    start = jnp.zeros(groups.shape[0], groups.dtype)
    logs, overlap = minimise(lambda logs, _: jax.grad(loss, has_aux=True)(logs), start, RATE, STEPS)
    return logs, _overlap(body, rig, pose, silhouettes), overlap
