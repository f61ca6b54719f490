"""What the detectors see of one frame: cameras, pictures, silhouettes, keypoints, and the person's hull, which several detectors use."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from bayes_body.initial.detection.figure import ChosenBody, Figure, choose_person, figure, interior_depths
from bayes_body.initial.detection.hull import VOXEL_M, Mask, Voxels, clean
from bayes_body.recording.observation.covered import uncovered
from bayes_body.recording.observation.frames import Frame, covered_of
from bayes_body.recording.observation.pictures import Colours
from bayes_body.recording.readers.camera_path import cameras_at
from bayes_body.recording.readers.keypoints.triangulate import project
from bayes_body.recording.session.session import CameraSpec, Keypoints, Session


@dataclass(frozen=True, eq=False)
class Scene:
    """One frame. Everything has one entry for each camera that saw it.

    Attributes:
        cameras: with their extrinsics in this frame.
        pictures: blue, green and red; a grey camera's channels are equal.
        masks: cleaned silhouettes, without what other people cover; None if the session has none.
        keypoints: the subject's keypoints by name; None if the session has none.
        up: index of the world's axis that points up.
        stature_m: the person's height, if it is known.
        covered: where other people cover the image, which is not seen; None for a camera that sees no other person.
    """

    cameras: Sequence[CameraSpec]
    pictures: Sequence[Colours]
    masks: Sequence[Mask] | None
    keypoints: Sequence[Keypoints | None] | None
    up: int
    stature_m: float | None = None
    covered: Sequence[Mask | None] | None = None

    @cached_property
    def chosen(self) -> ChosenBody:
        """The person's hull; without masks of two or more cameras there is none."""
        if self.masks is None or len(self.masks) < 2:
            return ChosenBody(None, ())
        return choose_person(self.cameras, self.masks, self.up, self.covered)

    @cached_property
    def figure(self) -> Figure | None:
        """The person's figure; None without a hull."""
        return None if self.chosen.voxels is None else figure(self.chosen.voxels, self.viewpoints, self.up, self.stature_m)

    @property
    def viewpoints(self) -> Float[np.ndarray, "camera 3"]:
        """The cameras' centres in the world, metres."""
        return np.stack([-camera.rotation.T @ camera.translation_m for camera in self.cameras])

    @cached_property
    def people(self) -> Sequence[Mask] | None:
        """The silhouettes without pixels far from the person's hull; unchanged if there is no hull; None without silhouettes."""
        if self.masks is None or self.chosen.voxels is None:
            return self.masks
        return [mask & _dilated_projection(camera, self.chosen.voxels, mask.shape) for camera, mask in zip(self.cameras, self.masks, strict=True)]

    def depths(self, points: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, " point"]:
        """Return how deep points lie inside the person's hull, metres: 0 outside; NaN without a hull."""
        if self.chosen.voxels is None:
            return np.full(len(points), np.nan)
        distance, nearest = KDTree(self.chosen.voxels).query(points)
        return np.where(distance < VOXEL_M, self._interior[nearest], 0.0)

    @cached_property
    def _interior(self) -> Float[np.ndarray, " voxel"]:
        return np.zeros(0) if self.chosen.voxels is None else interior_depths(self.chosen.voxels)

    @property
    def upwards(self) -> Float[np.ndarray, "3"]:
        """The unit vector that points up."""
        return np.eye(3)[self.up]

    def foreground(self, points: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, " point"]:
        """Return, of the views that show each point, the share that show it on the foreground; NaN if no view does, or without silhouettes."""
        hits, shown = np.zeros(len(points)), np.zeros(len(points))
        for camera, mask, covered in zip(self.cameras, self.people or (), self.covered or [None] * len(self.cameras), strict=False):
            pixels = project(camera, points)
            inside = _is_inside(pixels, mask.shape)
            if covered is not None:
                columns, rows = np.rint(pixels[inside]).astype(int).T
                inside[inside] = ~covered[rows, columns]
            columns, rows = np.rint(pixels[inside]).astype(int).T
            hits[inside] += mask[rows, columns]
            shown += inside
        return np.where(shown > 0, hits / np.maximum(shown, 1), np.nan)


def read_scene(session: Session, frame: Frame) -> Scene:
    """Return the scene of a frame. Cameras without a picture are left out, and cameras without a silhouette if the session has silhouettes.

    Raises:
        InputError: the background cannot be learned, or a file cannot be used.
    """
    pictures = (None,) * len(session.views) if frame.colours is None else list(frame.colours)
    masks = None if frame.masks is None else list(frame.masks)
    camera_indices = [c for c, picture in enumerate(pictures) if picture is not None and (masks is None or masks[c] is not None)]
    cameras, covered = cameras_at(session, frame.index), covered_of(frame)
    return Scene(
        [cameras[c] for c in camera_indices],
        [picture for c in camera_indices if (picture := pictures[c]) is not None],
        None if masks is None else [clean(uncovered(mask, covered[c])) for c in camera_indices if (mask := masks[c]) is not None],
        None if frame.keypoints is None else [frame.keypoints[c] for c in camera_indices],
        "xyz".index(session.up),
        session.subject.height_m,
        None if frame.covered is None else [covered[c] for c in camera_indices],
    )


def _dilated_projection(camera: CameraSpec, centres: Voxels, shape: tuple[int, ...]) -> Mask:
    """Return the voxels' projection, wider by two voxels. A mask keeps its holes in it, but loses shadows and other people."""
    pixels = project(camera, centres)
    depth = centres @ camera.rotation[2] + camera.translation_m[2]
    inside = _is_inside(pixels, shape)
    hit = np.zeros(shape, np.uint8)
    if not inside.any():
        return hit > 0
    columns, rows = np.rint(pixels[inside]).astype(int).T
    hit[rows, columns] = 1
    size = 2 * int(np.ceil(2 * VOXEL_M * max(camera.focal_px) / np.median(depth[inside]))) + 1
    return cv2.dilate(hit, np.ones((size, size), np.uint8)) > 0


def _is_inside(pixels: Float[np.ndarray, "point 2"], shape: tuple[int, ...]) -> Bool[np.ndarray, " point"]:
    """Return whether pixels (column, row) lie in an image of a shape (rows, columns)."""
    return np.isfinite(pixels).all(axis=1) & (pixels > -0.5).all(axis=1) & (pixels < (shape[1] - 0.5, shape[0] - 0.5)).all(axis=1)
