"""A person's shadow on the floor: the surface projected along the light, with a soft edge."""

import cv2
import numpy as np
from jaxtyping import Float

from bayes_body.recording.session.session import CameraSpec
from bayes_body.workshop.simulation.raster import doubled_area
from bayes_body.workshop.simulation.raster_spans import project, spans
from bayes_body.workshop.simulation.surface import Mesh

FLOOR_M = 0.001
# Least tangent of the lamp's elevation; with a lower lamp, shadows would be unbounded.
LOWEST_LAMP = 0.15
# Pixels per sample, in each direction.
COARSE = 4


def shadow(mesh: Mesh, direction: tuple[float, float, float]) -> Mesh:
    """Project a mesh onto the floor, z = 0.

    Args:
        mesh: the mesh that casts the shadow.
        direction: from the scene to the lamp, which is above.
    """
    east, north, up = direction
    up = max(up, LOWEST_LAMP * float(np.hypot(east, north)), 1e-6)
    flat = mesh.vertices - mesh.vertices[:, 2:] * (np.array([east, north, up]) / up)
    flat[:, 2] = FLOOR_M
    return mesh._replace(vertices=flat)


def shadow_mask(mesh: Mesh, camera: CameraSpec, direction: tuple[float, float, float], blur_px: float = 8.0) -> Float[np.ndarray, "row column"]:
    """The fraction of each pixel's floor in a mesh's shadow, 0 to 1, float32. It is drawn at a quarter of the resolution, blurred and enlarged.

    Args:
        mesh: the mesh that casts the shadow.
        camera: the camera; the floor is z = 0.
        direction: from the scene to the lamp.
        blur_px: standard deviation of the shadow's edge, pixels.
    """
    width, height = camera.size_px
    size = (-(-width // COARSE), -(-height // COARSE))
    points, _, visible = project(shadow(mesh, direction).vertices, camera)
    corners = ((points + 0.5) / COARSE - 0.5)[mesh.faces[visible[mesh.faces].all(axis=1)]]
    # Half of the faces are enough: those facing the lamp cover the same area as the others.
    covered = spans(corners[doubled_area(corners) < 0], size)
    # Each run adds one at its start and subtracts one at its end: samples with a positive sum are in the shadow.
    steps = np.bincount(covered.row * (size[0] + 1) + covered.start, minlength=size[1] * (size[0] + 1))
    ends = np.bincount(covered.row * (size[0] + 1) + covered.start + covered.length, minlength=size[1] * (size[0] + 1))
    mask = (np.cumsum((steps - ends).reshape(size[1], size[0] + 1), axis=1)[:, :-1] > 0).astype(np.float32)
    return np.clip(cv2.resize(cv2.GaussianBlur(mask, (0, 0), max(blur_px / COARSE, 0.1)), (width, height), interpolation=cv2.INTER_LINEAR), 0.0, 1.0)
