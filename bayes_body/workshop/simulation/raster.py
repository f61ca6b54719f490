r"""Rasterise triangles: find the nearest surface at several samples per pixel, light it by a lamp and the sky, and draw it over a picture.

Light: $c\,(a\,(1 + s\,n_z) + b \max(0, n \cdot l))$ for a reflectance c, a normal n, a direction l to the lamp and a sky that is brighter by s than
the mean of sky and floor (Lambert 1760). It is interpolated over a triangle from its corners, whose normals are means over the adjacent triangles.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from bayes_body.recording.session.session import CameraSpec
from bayes_body.workshop.simulation.person_motion import unit
from bayes_body.workshop.simulation.raster_spans import in_front, project, spans
from bayes_body.workshop.simulation.surface import Mesh

WHITE = 255.0
# By how much the sky is brighter, and the floor darker, than their mean.
SKY = 0.3
# The light on a surface is clipped here, because extrapolation can diverge on slivers.
BRIGHTEST = 1.6


class Light(NamedTuple):
    """How the scene is lit.

    Attributes:
        direction: from the scene to the lamp; any length.
        ambient: light from all directions.
        lamp: light from the lamp.
    """

    direction: tuple[float, float, float] = (0.6, -0.7, 0.9)
    ambient: float = 0.50
    lamp: float = 0.55


class Facing(NamedTuple):
    """The triangles that face a camera, the farthest first.

    Attributes:
        corners: (face, 3, 2), column and row in pixels.
        depth: (face, 3), metres.
        number: (face,), index of the triangle in the mesh.
    """

    corners: Float[np.ndarray, "face 3 2"]
    depth: Float[np.ndarray, "face 3"]
    number: Int[np.ndarray, " face"]


def rasterise(
    mesh: Mesh, camera: CameraSpec, picture: Float[np.ndarray, "row column 3"], light: Light = Light(), supersample: int = 2
) -> tuple[Float[np.ndarray, "row column 3"], Float[np.ndarray, "row column"]]:
    """Draw a mesh over a picture.

    Args:
        mesh: closed surfaces, triangles anticlockwise as seen from outside.
        camera: the camera.
        picture: the picture behind, blue, green, red, 0 to 255; it is not changed.
        light: the light sources.
        supersample: samples per pixel, in each direction.

    Returns:
        The picture, and the fraction of each pixel that the mesh covers, 0 to 1; float32.
    """
    picture, coverages = rasterise_people([mesh], camera, picture, light, supersample)
    return picture, coverages[0]


def rasterise_people(
    meshes: Sequence[Mesh], camera: CameraSpec, picture: Float[np.ndarray, "row column 3"], light: Light = Light(), supersample: int = 2
) -> tuple[Float[np.ndarray, "row column 3"], Float[np.ndarray, "person row column"]]:
    """Draw people over a picture; who is nearer hides who is behind. Arguments are those of `rasterise`, with at least one mesh.

    Returns:
        The picture, and the fraction of each pixel that each person visibly covers, 0 to 1; float32.
    """
    mesh = merged(meshes)
    picture = np.array(picture, np.float32)
    coverages = np.zeros((len(meshes), *picture.shape[:2]), np.float32)
    visible = facing(mesh, camera)
    window = _window(visible, camera.size_px)
    if window is None:
        return picture, coverages
    first_column, top, width, height = window
    size = (width * supersample, height * supersample)
    corners = ((visible.corners - (first_column, top) + 0.5) * supersample - 0.5).astype(np.float32)
    owner, covered = in_front(spans(corners, size), planes(corners, visible.depth), size)
    # The window has a margin, and a small or distant mesh may lie between the samples.
    if not covered.any():
        return picture, coverages
    shade = _shaded(mesh, visible.number, light)
    samples = _painted(owner, covered, planes(corners, shade), mesh.colours[visible.number])
    pixels = cv2.resize(samples, (width, height), interpolation=cv2.INTER_AREA)
    region = coverages[:, top : top + height, first_column : first_column + width]
    if len(meshes) == 1:
        region[0] = pixels[..., 3]
    else:
        person = np.repeat(np.arange(len(meshes)), [len(single.faces) for single in meshes])[visible.number]
        for number, coverage in enumerate(region):
            samples_of_person = (covered & (person[owner] == number)).astype(np.float32)
            coverage[:] = cv2.resize(samples_of_person, (width, height), interpolation=cv2.INTER_AREA)
    part = picture[top : top + height, first_column : first_column + width]
    part *= 1.0 - pixels[..., 3:]
    part += pixels[..., :3]
    return picture, coverages


def merged(meshes: Sequence[Mesh]) -> Mesh:
    """All meshes as one."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)])
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), faces, np.concatenate([mesh.colours for mesh in meshes]))


def facing(mesh: Mesh, camera: CameraSpec) -> Facing:
    """The triangles that face a camera and lie completely in front of it, the farthest first."""
    points, depth, visible = project(mesh.vertices, camera)
    index = np.flatnonzero(visible[mesh.faces].all(axis=1))
    corners = points[mesh.faces[index]]
    front = doubled_area(corners) < 0
    index, corners = index[front], corners[front]
    depths = depth[mesh.faces[index]]
    order = np.argsort(-depths.sum(axis=1))
    return Facing(corners[order], depths[order], index[order])


def planes(corners: Float[np.ndarray, "face 3 2"], values: Float[np.ndarray, "face 3"]) -> Float[np.ndarray, "face 3"]:
    """For each triangle the plane through a value at each corner: slopes by column and by row, and value at (0, 0); constant for slivers."""
    (x1, y1), (x2, y2) = (np.moveaxis(corners[:, corner] - corners[:, 0], -1, 0) for corner in (1, 2))
    v1, v2 = (values[:, corner] - values[:, 0] for corner in (1, 2))
    area = x1 * y2 - x2 * y1
    sliver = np.abs(area) < 0.05
    scale = np.where(sliver, 0.0, 1.0 / np.where(sliver, 1.0, area))
    by_column, by_row = (v1 * y2 - v2 * y1) * scale, (v2 * x1 - v1 * x2) * scale
    level = np.where(sliver, values.mean(axis=1), values[:, 0] - by_column * corners[:, 0, 0] - by_row * corners[:, 0, 1])
    return np.stack([by_column, by_row, level], axis=1)


def normals(mesh: Mesh) -> Float[np.ndarray, "vertex 3"]:
    """Unit normals at the vertices, as means over the adjacent triangles."""
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    faces = np.cross(b - a, c - a)
    count = len(mesh.vertices)
    corners = mesh.faces.ravel()
    return unit(np.stack([np.bincount(corners, np.repeat(faces[:, axis], 3), count) for axis in range(3)], axis=1))


def doubled_area(corners: Float[np.ndarray, "face 3 2"]) -> Float[np.ndarray, " face"]:
    """Twice the triangles' areas; negative if the corners run anticlockwise in the image, because rows count downwards."""
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]


def _window(visible: Facing, size: tuple[int, int]) -> tuple[int, int, int, int] | None:
    """The part of the image that the triangles touch: left, top, width, height; None if they touch none."""
    if not len(visible.number):
        return None
    columns, rows = visible.corners[..., 0].ravel(), visible.corners[..., 1].ravel()
    low = np.clip(np.floor([columns.min(), rows.min()]), 0, size).astype(int)
    high = np.clip(np.ceil([columns.max(), rows.max()]) + 1, 0, size).astype(int)
    (first_column, top), (width, height) = low.tolist(), (high - low).tolist()
    return (first_column, top, width, height) if width > 0 and height > 0 else None


def _shaded(mesh: Mesh, index: Int[np.ndarray, " face"], light: Light) -> Float[np.ndarray, "face 3"]:
    """The light at each corner of some triangles."""
    normal = normals(mesh)
    lamp = np.maximum(normal @ unit(np.array(light.direction)), 0.0)
    return (light.ambient * (1.0 + SKY * normal[:, 2]) + light.lamp * lamp)[mesh.faces[index]]


def _painted(
    owner: Int[np.ndarray, "row column"],
    covered: Bool[np.ndarray, "row column"],
    shade: Float[np.ndarray, "face 3"],
    colours: Float[np.ndarray, "face 3"],
) -> Float[np.ndarray, "row column 4"]:
    """Blue, green, red (0 to 255, 0 where nothing is drawn) and coverage at each sample."""
    samples = np.zeros((owner.size, 4), np.float32)
    sample = np.flatnonzero(covered).astype(np.int32)
    face = owner.ravel().take(sample)
    row = sample // np.int32(owner.shape[1])
    column = sample - row * np.int32(owner.shape[1])
    by_column, by_row, level = (np.ascontiguousarray(part, np.float32).take(face) for part in shade.T)
    lit = np.clip(by_column * column.astype(np.float32) + by_row * row.astype(np.float32) + level, 0.0, BRIGHTEST)
    tinted = (WHITE * colours).astype(np.float32).take(face, axis=0) * lit[:, None]
    samples[sample] = cv2.merge([np.minimum(tinted, WHITE).reshape(-1, 1, 3), np.ones((len(face), 1), np.float32)]).reshape(-1, 4)
    return samples.reshape(*owner.shape, 4)
