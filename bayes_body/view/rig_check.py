"""One picture that tells whether an import is right: all cameras, the world's axes, and the initial body projected."""

from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from cv2.typing import MatLike

from bayes_body.camera import Camera, project
from bayes_body.errors import wrong
from bayes_body.files import make_folder
from bayes_body.model import Model
from bayes_body.observation.frames import read_frame
from bayes_body.session import Session
from bayes_body.view.overlay import fit, grid, label, paint
from bayes_body.view.silhouette import intersection_over_union, outlines, projected_masks

AXIS_M = 0.5
# x red, y green, z blue; BGR.
AXIS_COLOURS = ((40, 40, 255), (40, 220, 40), (255, 90, 40))


def draw_check(session: Session, model: Model, path: Path) -> Path:
    """The picture, for the first frame; axes of half a metre from the world's origin, and how much of the silhouette the body covers.

    Raises:
        InputError: the picture cannot be written, or an image cannot be read.
    """
    frame = read_frame(session, 0)
    pose = np.asarray(model.initial["pose"])
    bodies, silhouettes = outlines(model, pose), projected_masks(model, pose, session)
    tiles = []
    for c, view in enumerate(session.views):
        picture = paint(frame.images[c], bodies[c], [])
        note = "" if _draw_axes(picture, jax.tree.map(lambda leaf, c=c: leaf[c], model.rig)) else "  (world origin not in view)"
        if frame.masks is not None:
            note = f"  IoU with its mask {intersection_over_union(silhouettes[c], frame.masks[c]):.2f}{note}"
        tiles.append(label(fit(picture), f"{view.camera.name}{note}"))
    make_folder(path.parent)
    if not cv2.imwrite(str(path), grid(tiles)):
        raise wrong(path, "cannot be written", "a folder that can be written", "check its permissions and free space")
    return path


def _draw_axes(picture: MatLike, camera: Camera) -> bool:
    """Draw the axes from the world's origin; False if the origin is not in the image."""
    points, visible = (np.asarray(out) for out in project(camera, AXIS_M * jnp.concatenate([jnp.zeros((1, 3)), jnp.eye(3)])))
    height, width = picture.shape[:2]
    inside = visible & (points >= 0).all(axis=1) & (points < (width, height)).all(axis=1)
    if not inside[0]:
        return False
    ends = np.round(points).astype(int)
    for end, seen, colour, name in zip(ends[1:], visible[1:], AXIS_COLOURS, "xyz", strict=True):
        if seen:
            cv2.arrowedLine(picture, tuple(ends[0]), tuple(end), colour, 3, cv2.LINE_AA, tipLength=0.1)
            cv2.putText(picture, name, tuple(end + 4), cv2.FONT_HERSHEY_SIMPLEX, 0.6, colour, 2, cv2.LINE_AA)
    return True
