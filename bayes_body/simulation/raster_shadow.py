"""A person's shadow on the floor: the surface flattened along the light, softened."""

import cv2
import numpy as np
from jaxtyping import Float

from bayes_body.session.session import CameraSpec
from bayes_body.simulation.mesh import Mesh
from bayes_body.simulation.raster import doubled_area
from bayes_body.simulation.raster_projection import project
from bayes_body.simulation.raster_spans import spans

FLOOR_M = 0.001
# The lamp stands at least this high, as the tangent of its elevation, or shadows would not end.
LOWEST_LAMP = 0.15
# Pixels to a sample, each way.
COARSE = 4


def shadow(mesh: Mesh, direction: tuple[float, float, float]) -> Mesh:
    """The mesh flattened onto the floor, z = 0.

    Args:
        mesh: what throws the shadow.
        direction: from the scene to the lamp, which is above.
    """
    east, north, up = direction
    up = max(up, LOWEST_LAMP * float(np.hypot(east, north)), 1e-6)
    flat = mesh.vertices - mesh.vertices[:, 2:] * (np.array([east, north, up]) / up)
    flat[:, 2] = FLOOR_M
    return mesh._replace(vertices=flat)


def shadow_mask(mesh: Mesh, camera: CameraSpec, direction: tuple[float, float, float], blur_px: float = 8.0) -> Float[np.ndarray, "row column"]:
    """How much of each pixel's floor lies in a mesh's shadow, 0 to 1, float32: drawn at a quarter of the resolution, blurred, enlarged.

    Args:
        mesh: what throws the shadow.
        camera: who looks; the floor is z = 0.
        direction: from the scene to the lamp.
        blur_px: standard deviation of the shadow's edge, pixels.
    """
    width, height = camera.size_px
    size = (-(-width // COARSE), -(-height // COARSE))
    points, _, visible = project(shadow(mesh, direction).vertices, camera)
    corners = ((points + 0.5) / COARSE - 0.5)[mesh.faces[visible[mesh.faces].all(axis=1)]]
    # The half that the lamp sees covers what the other half covers.
    covered = spans(corners[doubled_area(corners) < 0], size)
    # A run adds one where it starts and takes one where it ends: what is positive between is in the shadow.
    steps = np.bincount(covered.row * (size[0] + 1) + covered.start, minlength=size[1] * (size[0] + 1))
    ends = np.bincount(covered.row * (size[0] + 1) + covered.start + covered.length, minlength=size[1] * (size[0] + 1))
    mask = (np.cumsum((steps - ends).reshape(size[1], size[0] + 1), axis=1)[:, :-1] > 0).astype(np.float32)
    return np.clip(cv2.resize(cv2.GaussianBlur(mask, (0, 0), max(blur_px / COARSE, 0.1)), (width, height), interpolation=cv2.INTER_LINEAR), 0.0, 1.0)
