"""A room around cameras and person: floor, walls, furniture, and sheets on the walls. Nothing stands between a camera and the person."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.workshop.simulation import scene_texture as texture
from bayes_body.workshop.simulation.scene_texture import Maker, Texture

# Metres: distance of the walls behind the cameras and around the person's path, height above the highest camera, and least height of a room.
BEHIND_M, AROUND_M, ABOVE_M, LEAST_HEIGHT_M = 0.8, 2.6, 0.5, 2.8
# Clearance around the person's path, around a camera, and around the lines of sight between them.
FREE_M, CAMERA_FREE_M, SIGHT_FREE_M = 0.7, 0.5, 0.25
SHEET_M = 0.005
FURNITURE, SHEETS, ATTEMPTS = 14, 10, 30
# Size of a material's pattern before it repeats.
REPEAT_M = 2.0
UP = np.array([0.0, 0.0, 1.0])


class Surface(NamedTuple):
    """A rectangle with a texture.

    Attributes:
        corner: (3,), metres.
        sides: (2, 3), the two sides from the corner.
        texture: the texture on it.
        repeats: how many times the texture fits along each side.
        light: fraction of the lamp's light that it receives.
        floor: whether it is the floor.
    """

    corner: Float[np.ndarray, "3"]
    sides: Float[np.ndarray, "2 3"]
    texture: Texture
    repeats: tuple[float, float]
    light: float
    floor: bool = False


class Room(NamedTuple):
    """Everything in the scene that does not move.

    Attributes:
        low: (3,), corner of the room, metres.
        high: (3,), the opposite one.
        boxes: (box, 2, 3), corners of the furniture.
        surfaces: the surfaces of all of it.
    """

    low: Float[np.ndarray, "3"]
    high: Float[np.ndarray, "3"]
    boxes: Float[np.ndarray, "box 2 3"]
    surfaces: tuple[Surface, ...]


class Clearance(NamedTuple):
    """What furniture must not block: the positions of the cameras (camera, 3) and of the person's joints at any time (point, 3), metres."""

    cameras: Float[np.ndarray, "camera 3"]
    points: Float[np.ndarray, "point 3"]


def build_room(rng: np.random.Generator, clearance: Clearance, clutter: float) -> Room:
    """A random room; without clutter a bare one with plain colours."""
    low, high = _extent(clearance)
    boxes = _furniture(rng, clearance, low, high, round(FURNITURE * clutter))
    strength = min(clutter, 2.0)
    surfaces = [*_shell(rng, low, high, strength), *_sheets(rng, low, high, round(SHEETS * clutter), strength)]
    for box in boxes:
        surfaces += _block(rng, box, strength)
    return Room(low, high, np.array(boxes).reshape(-1, 2, 3), tuple(surfaces))


def _extent(clearance: Clearance) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    margin = np.array([AROUND_M, AROUND_M, 0])
    behind = np.array([BEHIND_M, BEHIND_M, ABOVE_M])
    low = np.minimum(clearance.cameras.min(axis=0) - behind, clearance.points.min(axis=0) - margin)
    high = np.maximum(clearance.cameras.max(axis=0) + behind, clearance.points.max(axis=0) + margin)
    low[2], high[2] = 0.0, max(high[2], LEAST_HEIGHT_M)
    return low, high


def _shell(rng: np.random.Generator, low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"], strength: float) -> list[Surface]:
    """Floor, ceiling and four walls."""
    size = high - low
    x, y, z = np.diag(size)
    floor, ceiling, paper = (_one_of(rng, makers)(rng, strength) for makers in (texture.FLOORS, (texture.plain,), texture.WALLS))
    places = (
        (low, (x, y), floor, 1.0),
        (low + z, (x, y), ceiling, 0.8),
        (low + z, (x, -z), paper, 0.85),
        (low + y + z, (x, -z), paper, 0.95),
        (low + z, (y, -z), paper, 0.75),
        (low + x + z, (y, -z), paper, 0.9),
    )
    return [_surface(corner, sides, worn, light, floor=number == 0) for number, (corner, sides, worn, light) in enumerate(places)]


def _surface(corner: Float[np.ndarray, "3"], sides: Sequence[Float[np.ndarray, "3"]], worn: Texture, light: float, floor: bool = False) -> Surface:
    lengths = [float(np.linalg.norm(side)) / REPEAT_M for side in sides]
    return Surface(corner, np.stack(sides), worn, (lengths[0], lengths[1]), light, floor)


def _sheets(rng: np.random.Generator, low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"], count: int, strength: float) -> list[Surface]:
    """Posters and boards on the walls, each some millimetres in front of those that it may cover."""
    sheets = []
    for number in range(count):
        gap = SHEET_M * (number + 1)
        axis, is_far_wall = int(rng.integers(2)), int(rng.integers(2))
        wall_axis = np.eye(3)[1 - axis]
        width, height = rng.uniform(0.4, 1.4), rng.uniform(0.4, 1.1)
        place = rng.uniform(low[1 - axis], max(high[1 - axis] - width, low[1 - axis] + 0.1))
        corner = np.zeros(3)
        corner[axis] = (high if is_far_wall else low)[axis] + (-gap if is_far_wall else gap)
        corner[1 - axis], corner[2] = place, rng.uniform(max(height + 0.4, 1.5), max(high[2] - 0.2, 1.6 + height))
        sheets.append(Surface(corner, np.stack([width * wall_axis, -height * UP]), texture.poster(rng, strength), (1.0, 1.0), rng.uniform(0.8, 1.1)))
    return sheets


def _block(rng: np.random.Generator, box: Float[np.ndarray, "2 3"], strength: float) -> list[Surface]:
    """The five visible sides of a piece of furniture."""
    low, high = box
    x, y, z = np.diag(high - low)
    front, top = _one_of(rng, texture.FRONTS)(rng, strength), texture.plain(rng, strength)
    sides = ((low + z, x, 0.85), (low + y + z, x, 0.95), (low + z, y, 0.75), (low + x + z, y, 0.9))
    walls = [Surface(corner, np.stack([side, -z]), front, (1.0, 1.0), light) for corner, side, light in sides]
    return [*walls, Surface(low + z, np.stack([x, y]), top, (0.5, 0.5), 1.1)]


def _furniture(
    rng: np.random.Generator, clearance: Clearance, low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"], count: int
) -> list[Float[np.ndarray, "2 3"]]:
    boxes: list[Float[np.ndarray, "2 3"]] = []
    for _ in range(count):
        for _ in range(ATTEMPTS):
            box = _somewhere(rng, low, high)
            if _is_free(box, boxes, clearance):
                boxes.append(box)
                break
    return boxes


def _somewhere(rng: np.random.Generator, low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]) -> Float[np.ndarray, "2 3"]:
    """A piece of furniture against a wall, or, one time in four, inside the room."""
    axis = int(rng.integers(2))
    size = np.zeros(3)
    size[axis], size[1 - axis], size[2] = rng.uniform(0.3, 0.6), rng.uniform(0.5, 1.5), rng.uniform(0.4, 2.0)
    corner = rng.uniform(low, np.maximum(high - size, low + 1e-3))
    corner[2] = 0.0
    if rng.random() < 0.75:
        corner[axis] = high[axis] - size[axis] - 0.002 if rng.random() < 0.5 else low[axis] + 0.002
    return np.stack([corner, corner + size])


def _is_free(box: Float[np.ndarray, "2 3"], boxes: Sequence[Float[np.ndarray, "2 3"]], clearance: Clearance) -> bool:
    low, high = box
    way = np.stack([clearance.points.min(axis=0), clearance.points.max(axis=0)])[:, :2] + [[-FREE_M], [FREE_M]]
    if (low[:2] < way[1]).all() and (high[:2] > way[0]).all():
        return False
    if any((low < obstacle[1] + 0.05).all() and (high > obstacle[0] - 0.05).all() for obstacle in boxes):
        return False
    if ((clearance.cameras > low - CAMERA_FREE_M) & (clearance.cameras < high + CAMERA_FREE_M)).all(axis=1).any():
        return False
    return not any(_blocks(low - SIGHT_FREE_M, high + SIGHT_FREE_M, camera, clearance.points) for camera in clearance.cameras)


def _blocks(low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"], camera: Float[np.ndarray, "3"], points: Float[np.ndarray, "point 3"]) -> bool:
    """Whether a box lies between a camera and any of the points (slab test: the ray enters all slabs before it leaves one)."""
    ray = points - camera
    ray = np.where(np.abs(ray) < 1e-9, 1e-9, ray)
    first, second = (low - camera) / ray, (high - camera) / ray
    enter, leave = np.minimum(first, second).max(axis=1), np.maximum(first, second).min(axis=1)
    return bool(((enter < leave) & (leave > 0) & (enter < 1)).any())


def _one_of(rng: np.random.Generator, makers: Sequence[Maker]) -> Maker:
    return makers[int(rng.integers(len(makers)))]
