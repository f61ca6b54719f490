"""A picture for checking an import: the images of all cameras with the world's axes, the floor and the initial body drawn over them.

Beside each whole image is the part of it that shows the body, so large that an error of one centimetre is seen.
"""

from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from cv2.typing import MatLike
from jaxtyping import Bool, Float

from bayes_body.base.files.atomic import make_folder
from bayes_body.base.geometry.camera import Camera, project
from bayes_body.model.build import Model
from bayes_body.recording.observation.frames import read_frame
from bayes_body.recording.session.session import Session
from bayes_body.results.metrics.fit import Outline, intersection_over_union, outlines, projected_masks
from bayes_body.view.colours import FLOOR_LINES, WORLD_AXES, bgr
from bayes_body.view.crop import Crop, crop_about
from bayes_body.view.overlay import backdrop, label, paint, write_png
from bayes_body.view.windows import EMPTY, STILL_HEIGHT, grid

AXIS_M = 0.5
# The floor has tiles of one metre, and extends this far from the origin. Lines are drawn in short pieces, because lens distortion bends them.
FLOOR_M, PIECE_M = 3, 0.1
# Only a camera of an odd shape has a wider tile, pixels.
WIDEST = 4 * STILL_HEIGHT


def draw_check(session: Session, model: Model, path: Path) -> Path:
    """Write the picture of the first frame, and return its path.

    It shows axes of half a metre from the world's origin, with a label at the upward one, and a grid of one-metre tiles at height 0. The grid lies on
    the real floor if the world's origin is at floor height. If the session has masks, the picture also gives the body's overlap (IoU) with them.

    Raises:
        InputError: the picture cannot be written, or an image cannot be read.
    """
    pose = np.asarray(model.initial[model.body.variable])
    bodies, silhouettes = outlines(model, pose), projected_masks(model, pose, session)
    # Masks are used only if they exist as files: no background is learned for this picture.
    masks = read_frame(session, 0).masks if all(view.masks for view in session.views) else None
    tiles = []
    for c, view in enumerate(session.views):
        picture, note = backdrop(session, 0, view)
        camera = jax.tree.map(lambda leaf, c=c: leaf[c], model.rig)
        mask = None if masks is None else masks[c]
        if mask is not None:
            note = f"\nIoU with its mask {intersection_over_union(silhouettes[c], mask):.2f}{note}"
        tiles.append(_tile(picture, camera, bodies[c], session.up, f"{view.camera.name}{note}"))
    make_folder(path.parent)
    write_png(path, grid(tiles))
    return path


def _tile(picture: MatLike, camera: Camera, body: list[Outline], up: str, text: str) -> MatLike:
    """Return the whole image, and beside it the part of it that shows the body, larger."""
    size = picture.shape[1], picture.shape[0]
    full_crop = whole_image(size)
    shown = _with_body(_draw_floor(full_crop.cut(picture), full_crop, camera, "xyz".index(up)), full_crop, body)
    if not _draw_axes(shown, full_crop, camera, up):
        text += "\nworld origin not in view"
    tiles = [label(padded(shown), text)]
    points = np.concatenate([part.polygon for part in body]) if body else np.full((1, 2), -1.0)
    middle = points.mean(axis=0)
    if (middle >= 0).all() and (middle < size).all():
        close_crop = crop_about(points, size, STILL_HEIGHT, most_zoom=np.inf)
        tiles.append(padded(_with_body(close_crop.cut(picture), close_crop, body)))
    return np.hstack(tiles)


def whole_image(size_px: tuple[int, int]) -> Crop:
    """Return an image of that size (width, height) as a tile of STILL_HEIGHT; one of an odd shape is lower, so that it is no wider than WIDEST."""
    return Crop(0, 0, *size_px, min(STILL_HEIGHT / size_px[1], WIDEST / size_px[0]))


def padded(picture: MatLike) -> MatLike:
    """Return the picture with empty room below it, up to STILL_HEIGHT."""
    picture = picture[:STILL_HEIGHT]
    return cv2.copyMakeBorder(picture, 0, STILL_HEIGHT - picture.shape[0], 0, 0, cv2.BORDER_CONSTANT, value=(EMPTY,) * 3)


def _with_body(picture: MatLike, crop: Crop, body: list[Outline]) -> MatLike:
    return paint(picture, [Outline(part, crop.place(polygon)) for part, polygon in body], [])


def _draw_axes(picture: MatLike, crop: Crop, camera: Camera, up: str) -> bool:
    """Draw the axes from the world's origin, and return whether the origin is in the picture."""
    points, visible = (np.asarray(out) for out in project(camera, AXIS_M * jnp.concatenate([jnp.zeros((1, 3)), jnp.eye(3)])))
    points = crop.place(points)
    if not _inside(picture, points, visible)[0]:
        return False
    ends = np.round(points).astype(int)
    for end, is_visible, colour, name in zip(ends[1:], visible[1:], WORLD_AXES, "xyz", strict=True):
        if is_visible:
            cv2.arrowedLine(picture, tuple(ends[0]), tuple(end), bgr(colour), 4, cv2.LINE_AA, tipLength=0.1)
            text = f"{name} (up)" if name == up else name
            cv2.putText(picture, text, tuple(end + 6), cv2.FONT_HERSHEY_SIMPLEX, 1.0, bgr(colour), 3, cv2.LINE_AA)
    return True


def _draw_floor(picture: MatLike, crop: Crop, camera: Camera, up: int) -> MatLike:
    """Return the picture with half-transparent one-metre tiles in the horizontal plane through the world's origin."""
    lines = _floor_lines(up)
    points, visible = (np.asarray(out) for out in project(camera, jnp.asarray(lines.reshape(-1, 3), float)))
    points = crop.place(points)
    shown = _inside(picture, points, visible).reshape(lines.shape[:2])
    pixels = np.round(np.where(np.isfinite(points), points, 0)).astype(int).reshape(*lines.shape[:2], 2)
    drawn = picture.copy()
    for line, visibility in zip(pixels, shown, strict=True):
        for k in np.flatnonzero(visibility[:-1] & visibility[1:]):
            cv2.line(drawn, tuple(line[k]), tuple(line[k + 1]), FLOOR_LINES, 2, cv2.LINE_AA)
    return cv2.addWeighted(drawn, 0.6, picture, 0.4, 0)


def _floor_lines(up: int) -> Float[np.ndarray, "line point 3"]:
    """Return lines one metre apart along both horizontal axes, as points in the world."""
    places = np.linspace(-FLOOR_M, FLOOR_M, round(2 * FLOOR_M / PIECE_M) + 1)
    first, second = (axis for axis in range(3) if axis != up)
    lines = []
    for fixed, running in ((first, second), (second, first)):
        for value in range(-FLOOR_M, FLOOR_M + 1):
            line = np.zeros((places.size, 3))
            line[:, fixed], line[:, running] = value, places
            lines.append(line)
    return np.stack(lines)


def _inside(picture: MatLike, points: Float[np.ndarray, "point 2"], visible: Bool[np.ndarray, " point"]) -> Bool[np.ndarray, " point"]:
    height, width = picture.shape[:2]
    return visible & (points >= 0).all(axis=1) & (points < (width, height)).all(axis=1)
