r"""Render the room: each pixel's ray $c + t\,d$ meets a surface's plane at $t = (p - c) \cdot n / d \cdot n$; the nearest surface is drawn."""

from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from bayes_body.recording.session.session import CameraSpec
from bayes_body.workshop.simulation.scene_room import Room, Surface
from bayes_body.workshop.simulation.scene_texture import Texture

# Metres: cell width of the floor's light map, and distance within which furniture blocks light.
CELL_M, SHADE_M = 0.04, 0.18
# Brightness of the floor next to furniture; brightness below the lamp in the room's middle, and far from it; the lamp's width.
CONTACT, NEAR_LIGHT, FAR_LIGHT, LAMP_M = 0.45, 1.08, 0.72, 4.0
# A direction is used only if it is at least this many metres in front of the camera.
NEAR_M = 0.05
# Grey level of pixels whose rays meet nothing.
NOTHING = 30.0


class EmptyScene(NamedTuple):
    """A picture of the empty scene.

    Attributes:
        picture: blue, green, red, grey levels from 0 to 255.
        floor: where the floor is visible.
    """

    picture: Float[np.ndarray, "row column 3"]
    floor: Bool[np.ndarray, "row column"]


class Scene:
    """A room that any camera can view."""

    def __init__(self, room: Room):
        self.room = room
        self._light = _floor_light(room)

    def look(self, camera: CameraSpec) -> EmptyScene:
        """The camera's picture of the scene, through its lens."""
        lens = _lens(camera.size_px, camera.focal_px, camera.centre_px, camera.skew, camera.distortion)
        rays = lens @ camera.rotation.astype(np.float32)
        viewpoint = -camera.rotation.T @ camera.translation_m
        depth = np.full(rays.shape[:2], np.inf, np.float32)
        picture, floor = np.full(rays.shape, NOTHING, np.float32), np.zeros(rays.shape[:2], bool)
        for surface in self.room.surfaces:
            window = _window(surface, lens, camera)
            _draw(picture[window], depth[window], floor[window], surface, rays[window], viewpoint, camera.focal_px[0])
        return EmptyScene(picture * self._lit(viewpoint, depth, rays, floor)[..., None], floor)

    def _lit(
        self, viewpoint: Float[np.ndarray, "3"], depth: Float[np.ndarray, "row column"], rays: Float[np.ndarray, "row column 3"], floor: np.ndarray
    ) -> Float[np.ndarray, "row column"]:
        """Light from the lamp in the room's middle, and the shade of furniture on the floor."""
        x, y = (viewpoint[axis] + np.where(np.isfinite(depth), depth, 0) * rays[..., axis] for axis in (0, 1))
        middle = (self.room.low + self.room.high) / 2
        exponent = ((x - middle[0]) ** 2 + (y - middle[1]) ** 2) / (2 * LAMP_M**2)
        light = FAR_LIGHT + (NEAR_LIGHT - FAR_LIGHT) * np.exp(-exponent)
        columns, rows = ((positions - low) / CELL_M for positions, low in zip((x, y), self.room.low, strict=False))
        shade = cv2.remap(self._light, columns.astype(np.float32), rows.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return (light * np.where(floor, shade, 1.0)).astype(np.float32)


@lru_cache(maxsize=16)
def _lens(
    size: tuple[int, int], focal: tuple[float, float], centre: tuple[float, float], skew: float, distortion: tuple[float, ...]
) -> Float[np.ndarray, "row column 3"]:
    """Each pixel's ray in the camera's frame, with third component 1."""
    width, height = size
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 1, 2).astype(np.float64)
    # OpenCV's camera matrix would ignore the skew.
    pixels[..., 0] -= skew * focal[0] / focal[1] * (pixels[..., 1] - centre[1])
    matrix = np.array([[focal[0], 0, centre[0]], [0, focal[1], centre[1]], [0, 0, 1]])
    plane = cv2.undistortPoints(pixels, matrix, np.array(distortion)).reshape(height, width, 2)
    return np.concatenate([plane, np.ones((height, width, 1))], axis=-1).astype(np.float32)


def _window(surface: Surface, lens: Float[np.ndarray, "row column 3"], camera: CameraSpec) -> tuple[slice, slice]:
    """The rows and columns in which a surface can be visible; all of them if part of it is behind the camera."""
    corners = surface.corner + np.array([[0, 0], [0, 1], [1, 0], [1, 1]]) @ surface.sides
    inside = corners @ camera.rotation.T + camera.translation_m
    if inside[:, 2].min() < NEAR_M:
        return slice(None), slice(None)
    x, y = (inside[:, :2] / inside[:, 2:]).T
    # The lens bends rows and columns, so each of them covers a range of directions.
    rows = _span(lens[..., 1], 1, float(y.min()), float(y.max()))
    return rows, _span(lens[..., 0], 0, float(x.min()), float(x.max()))


def _span(directions: Float[np.ndarray, "row column"], axis: int, low: float, high: float) -> slice:
    met = np.flatnonzero((directions.max(axis=axis) >= low) & (directions.min(axis=axis) <= high))
    return slice(int(met[0]), int(met[-1]) + 1) if met.size else slice(0, 0)


def _draw(
    picture: Float[np.ndarray, "row column 3"],
    depth: Float[np.ndarray, "row column"],
    floor: Bool[np.ndarray, "row column"],
    surface: Surface,
    rays: Float[np.ndarray, "row column 3"],
    viewpoint: Float[np.ndarray, "3"],
    focal_px: float,
) -> None:
    """Draw a surface where it is nearer than what was drawn so far (in place)."""
    if not depth.size:
        return
    lengths = (surface.sides**2).sum(axis=1)
    normal = np.cross(*surface.sides)
    offset = viewpoint - surface.corner
    # Columns: the ray's components along the normal and along both sides, each in units of the side's length.
    axes = np.stack([normal, surface.sides[0] / lengths[0], surface.sides[1] / lengths[1]], axis=1)
    components = rays @ axes.astype(np.float32)
    start = (offset @ axes).astype(np.float32)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        t = -start[0] / components[..., 0]
        u, v = (start[k] + t * components[..., k] for k in (1, 2))
        mask = (t > 1e-4) & (t < depth) & (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)
    if not mask.any():
        return
    depth[mask] = t[mask]
    floor[mask] = surface.floor
    texel = np.sqrt(lengths.max()) / (max(surface.repeats) * surface.texture.shape[0])
    worn = _shrunk(surface.texture, float(np.median(t[mask])) / focal_px / texel)
    picture[mask] = surface.light * _worn(worn, surface.repeats, u[mask], v[mask])


def _shrunk(texture: Texture, texels: float) -> UInt8[np.ndarray, "side side 3"]:
    """The texture reduced in size where a pixel covers several of its texels, which would cause flicker."""
    side = texture.shape[0] >> int(np.clip(round(np.log2(max(texels, 1e-3))), 0, 5))
    return texture if side == texture.shape[0] else cv2.resize(texture, (side, side), interpolation=cv2.INTER_AREA).astype(np.uint8)


def _worn(
    texture: UInt8[np.ndarray, "side side 3"], repeats: tuple[float, float], u: Float[np.ndarray, " pixel"], v: Float[np.ndarray, " pixel"]
) -> Float[np.ndarray, "pixel 3"]:
    """The texture's colours at positions on a surface, both coordinates from 0 to 1."""
    side = texture.shape[0]
    # Split into lines of this many pixels: OpenCV's images are at most 32767 pixels wide.
    width = 1024
    padded = -(-u.size // width) * width
    columns, rows = (np.resize(coordinates * repeat * side, padded).reshape(-1, width) for coordinates, repeat in zip((u, v), repeats, strict=True))
    colours = cv2.remap(texture, columns.astype(np.float32), rows.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return colours.reshape(-1, 3)[: u.size].astype(np.float32)


def _floor_light(room: Room) -> Float[np.ndarray, "row column"]:
    """The fraction of light that reaches each cell of the floor past furniture and walls."""
    size = np.ceil((room.high - room.low)[:2] / CELL_M).astype(int)
    x, y = np.meshgrid(*(room.low[axis] + CELL_M * np.arange(size[axis]) for axis in (0, 1)))
    light = np.ones(x.shape, np.float32)
    for low, high in room.boxes:
        outside = np.hypot(*(np.maximum(np.maximum(low[axis] - coordinates, coordinates - high[axis]), 0) for axis, coordinates in ((0, x), (1, y))))
        light = np.minimum(light, 1 - CONTACT * np.exp(-outside / SHADE_M))
    return light.astype(np.float32)
