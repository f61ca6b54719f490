r"""The person's figure in a visual hull: floor, crown, centre line of the trunk, line of the shoulders, and extremities.

Extremities are accumulative geodesic extrema (Plagemann, Ganapathi, Koller & Thrun 2010): the voxel farthest from the pelvis on the hull's graph;
then, again and again, the voxel farthest from the pelvis and all paths found so far. The path from an extremity to the pelvis keeps to the middle of
a limb, since an edge costs its length divided by the depth inside the hull.

The trunk is found for people who are roughly upright. Shoulders are at the fraction of the stature of Drillis & Contini (1966); hips are at 0.51, a
little lower than their 0.53, as in walking.

Among the bodies of a visual hull, the person is the largest one that is as tall as a person, without the shadow on the floor.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import KDTree

from bayes_body.initial.detection.hull import VOXEL_M, Mask, Voxels, bodies, carve, neighbours
from bayes_body.recording.session.session import CameraSpec

# A person's least height and volume; a crouching adult is larger than both.
LEAST_HEIGHT_M, LEAST_VOLUME_M3 = 0.5, 0.01
# A second body of at least this share of the largest one's volume, and this tall, is a second person.
SECOND_SHARE, SECOND_HEIGHT_M = 0.3, 0.9
# If the lowest voxel is farther from the height 0 than this, the world's origin is not on the floor.
FLOOR_M = 0.25
# A shadow lies on the floor: it is below the first height, and farther than FOOT_M from all voxels between the two heights.
SHADOW_M, SHIN_M, FOOT_M = 0.15, 0.45, 0.2


class ChosenBody(NamedTuple):
    """The person's voxels, None if there is no person; and sentences for the reader."""

    voxels: Voxels | None
    notices: tuple[str, ...]


def choose_person(cameras: Sequence[CameraSpec], masks: Sequence[Mask], up: int, covered: Sequence[Mask | None] | None = None) -> ChosenBody:
    """Return the largest person in the hull of two or more cleaned masks.

    Args:
        cameras: with their extrinsics in this frame.
        masks: of each camera.
        up: index of the world's axis that points up.
        covered: where known other people cover each camera's image.
    """
    people = [body for body in bodies(_on_floor(carve(cameras, masks, covered), up)) if _is_person(body, up)]
    if not people:
        return ChosenBody(None, ("the silhouettes have no body in common that is as large as a person",))
    return ChosenBody(people[0], _notice_of_others(people, up))


def floor_height(centres: Voxels, up: int) -> float:
    """Return the floor's height: 0, as in the world of a session by convention, unless the body's lowest voxels are far from it."""
    lowest = float(np.percentile(centres[:, up], 0.5)) - VOXEL_M / 2
    return 0.0 if abs(lowest) <= FLOOR_M else lowest


def _notice_of_others(people: Sequence[Voxels], up: int) -> tuple[str, ...]:
    first, smaller_bodies = people[0], people[1:]
    large_bodies = [body for body in smaller_bodies if len(body) >= SECOND_SHARE * len(first) and np.ptp(body[:, up]) >= SECOND_HEIGHT_M]
    if not large_bodies:
        return ()
    count = {1: "two", 2: "three"}.get(len(large_bodies), "several")
    sizes = ", ".join(f"{_litres(body):.0f} at {_place(body)}" for body in large_bodies)
    return (f"{count} people: the one at {_place(first)} was taken, it is the largest ({_litres(first):.0f} litres; the rest: {sizes})",)


def _litres(body: Voxels) -> float:
    return 1000 * len(body) * VOXEL_M**3


def _place(body: Voxels) -> str:
    return "(" + ", ".join(f"{value:.1f}" for value in body.mean(axis=0)) + ") m"


def _is_person(body: Voxels, up: int) -> bool:
    return bool(len(body) * VOXEL_M**3 >= LEAST_VOLUME_M3 and np.ptp(body[:, up]) >= LEAST_HEIGHT_M)


def _on_floor(centres: Voxels, up: int) -> Voxels:
    """Return the hull above the floor, without the shadow on it."""
    body_voxels = bodies(centres)
    if not body_voxels:
        return centres
    above = centres[:, up] - floor_height(body_voxels[0], up)
    level = np.delete(centres, up, axis=1)
    standing = (above > SHADOW_M) & (above < SHIN_M)
    if not standing.any():
        return centres
    distance = KDTree(level[standing]).query(level, distance_upper_bound=FOOT_M)[0]
    return centres[(above > SHADOW_M) | ((distance < FOOT_M) & (above > -VOXEL_M))]


# Heights of hip and shoulder above the floor, and half the thickness of the slabs in which the trunk's middle is measured; fractions of the height.
HIP, SHOULDER, SLAB = 0.51, 0.818, 0.04
# The slab in which the line of the shoulders is measured.
CHEST, CHEST_PERCENTILES = (0.76, 0.82), (3, 97)
# The most extremities that are found, and their least distance from the pelvis and from the paths of the others.
MOST_TIPS, NEAREST_M = 7, 0.18
# A hull within these heights, as shares of the stature, is that of a person who stands, perhaps with parts that are missing in the masks.
# A walker's crown is a little below the stature (0.95 to 1 of it in motion capture).
STANDS, WALKING = (0.75, 1.1), 0.95
# Thickness of a thin part, such as an arm. The crown belongs to a thicker part of the hull.
THIN_M = 0.06


class Figure(NamedTuple):
    """The person's figure, metres in the world.

    Attributes:
        floor: height of the floor.
        height: from the floor to the crown; for a person who stands, at least that of a walker of the given stature.
        crown: the highest point of the hull's head.
        pelvis: the middle of the trunk at the height of the hips.
        thorax: the middle of the trunk at the height of the shoulders.
        shoulder_axis: horizontal unit vector along the line of the shoulders; its sign has no meaning.
        elongation: ratio of the chest's width to its depth; near 1 the line of the shoulders is not known.
        paths: for each extremity, the points from its tip to the pelvis.
    """

    floor: float
    height: float
    crown: Float[np.ndarray, "3"]
    pelvis: Float[np.ndarray, "3"]
    thorax: Float[np.ndarray, "3"]
    shoulder_axis: Float[np.ndarray, "3"]
    elongation: float
    paths: tuple[Float[np.ndarray, "point 3"], ...]


def figure(centres: Voxels, viewpoints: Float[np.ndarray, "view 3"], up: int, stature_m: float | None = None) -> Figure:
    """Return the figure of one body, seen from cameras at `viewpoints` (metres); `up` is the index of the world's axis that points up.

    If the stature is known and the hull is nearly as high, the person stands. The height is then at least that of a walker of this stature, since
    masks more often miss the head than people stoop.
    """
    depths = interior_depths(centres)
    floor = floor_height(centres, up)
    crown = _crown(centres, depths, up)
    height = float(crown[up] - floor)
    if stature_m is not None and STANDS[0] < height / stature_m < STANDS[1]:
        height = max(height, WALKING * stature_m)
    pelvis, thorax = (_middle(centres, depths, floor + share * height, height, up) for share in (HIP, SHOULDER))
    shoulder_axis, elongation = _shoulder_axis(centres, thorax, floor + height * np.array(CHEST), viewpoints, up)
    return Figure(floor, height, crown, pelvis, thorax, shoulder_axis, elongation, _paths(centres, depths, pelvis))


def interior_depths(centres: Voxels) -> Float[np.ndarray, " voxel"]:
    """Return each voxel's distance to the outside, metres."""
    cells = np.rint((centres - centres.min(axis=0)) / VOXEL_M).astype(int) + 1
    filled = np.zeros(cells.max(axis=0) + 2, bool)
    filled[tuple(cells.T)] = True
    return VOXEL_M * np.asarray(distance_transform_edt(filled))[tuple(cells.T)]


def _crown(centres: Voxels, depths: Float[np.ndarray, " voxel"], up: int) -> Float[np.ndarray, "3"]:
    """Return the top of the highest part that is thicker than an arm; if there is none, the top of the highest part."""
    thick = depths > THIN_M
    candidates, inside = (centres[thick], depths[thick]) if thick.any() else (centres, depths)
    top = np.argmax(candidates[:, up])
    crown = candidates[top].copy()
    level = candidates[:, up] > crown[up] - VOXEL_M / 2
    crown = candidates[level].mean(axis=0)
    crown[up] += inside[top] - VOXEL_M / 2
    return crown


def _middle(centres: Voxels, depths: Float[np.ndarray, " voxel"], level: float, height: float, up: int) -> Float[np.ndarray, "3"]:
    """Return the middle of the trunk at a height. Deep voxels count more, so that arms beside the trunk count little."""
    weights = depths**3 * np.exp(-0.5 * ((centres[:, up] - level) / (SLAB * height)) ** 2)
    middle = weights @ centres / weights.sum()
    middle[up] = level
    return middle


def _shoulder_axis(
    centres: Voxels, thorax: Float[np.ndarray, "3"], height_of_chest: Float[np.ndarray, "2"], viewpoints: Float[np.ndarray, "view 3"], up: int
) -> tuple[Float[np.ndarray, "3"], float]:
    """Return the line of the shoulders, and the ratio of the chest's width to its depth.

    An ellipse with the matrix S has, seen from the horizontal direction d, the width w with $w^2 = u^T S u$, where u is perpendicular to d. The hull
    fills the corners between the views, so its widths in the views tell more than its moments.
    """
    chest = centres[(centres[:, up] > height_of_chest[0]) & (centres[:, up] < height_of_chest[1])]
    level = [k for k in range(3) if k != up]
    towards = (thorax - viewpoints)[:, level]
    u = towards[:, ::-1] * (-1, 1) / np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-6)
    if len(chest) < 4:
        return np.eye(3)[level[0]], 1.0
    widths = np.ptp(np.percentile(chest[:, level] @ u.T, CHEST_PERCENTILES, axis=0), axis=0)
    rows = np.stack([u[:, 0] ** 2, 2 * u[:, 0] * u[:, 1], u[:, 1] ** 2], axis=1)
    # With two views, this is the smallest solution.
    a, b, c = np.linalg.lstsq(rows, widths**2, rcond=None)[0]
    spread, axes = np.linalg.eigh([[a, b], [b, c]])
    shoulder_axis = np.zeros(3)
    shoulder_axis[level] = axes[:, 1]
    return shoulder_axis, float(np.sqrt(spread[1] / max(spread[0], 0.1 * spread[1])))


def _paths(centres: Voxels, depths: Float[np.ndarray, " voxel"], pelvis: Float[np.ndarray, "3"]) -> tuple[Float[np.ndarray, "point 3"], ...]:
    graph = neighbours(centres)
    root = int(np.argmin(((centres - pelvis) ** 2).sum(axis=1)))
    inner = coo_array((graph.data / np.minimum(depths[graph.row], depths[graph.col]), (graph.row, graph.col)), graph.shape)
    predecessors = dijkstra(inner.tocsr(), directed=False, indices=root, return_predecessors=True)[1]
    lengths, reached, paths = graph.tocsr(), np.array([root]), []
    for _ in range(MOST_TIPS):
        tip, distance = _farthest(lengths, reached)
        if distance < NEAREST_M:
            break
        path = _path(predecessors, tip)
        reached = np.union1d(reached, path)
        paths.append(_smooth(centres[path]))
    return tuple(paths)


def _farthest(lengths: csr_array, reached: Int[np.ndarray, " voxel"]) -> tuple[int, float]:
    distances = dijkstra(lengths, directed=False, indices=reached, min_only=True)
    tip = int(np.argmax(distances))
    return tip, float(distances[tip])


def _path(predecessors: Int[np.ndarray, " voxel"], tip: int) -> list[int]:
    path = [tip]
    while predecessors[path[-1]] >= 0:
        path.append(int(predecessors[path[-1]]))
    return path


def _smooth(path: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "point 3"]:
    """Return the path smoothed over five neighbours, without the steps of the voxels; the tip stays."""
    if len(path) < 5:
        return path
    padded = np.concatenate([path[:1].repeat(2, 0), path, path[-1:].repeat(2, 0)])
    smooth = np.stack([padded[k : k + len(path)] for k in range(5)]).mean(axis=0)
    smooth[0] = path[0]
    return smooth
