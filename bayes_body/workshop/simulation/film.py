"""Film people: for each camera and frame, combine the empty scene, the people's shadows on the floor and the people, and apply the sensor.

The empty scene is a drawn room, or a user's picture.
"""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from bayes_body.base.errors import input_error
from bayes_body.base.files.atomic import make_folder
from bayes_body.recording.readers.images import is_image, read_colour
from bayes_body.recording.readers.rig import Rig
from bayes_body.recording.readers.sources import find_background
from bayes_body.recording.readers.videos.video import probe, read_video_frame, readable_frames
from bayes_body.recording.session.session import CameraSpec
from bayes_body.workshop.simulation.options import Options, Quality
from bayes_body.workshop.simulation.raster import Light, merged, rasterise_people
from bayes_body.workshop.simulation.raster_shadow import shadow_mask
from bayes_body.workshop.simulation.scene import EmptyScene, Scene
from bayes_body.workshop.simulation.scene_room import Clearance, build_room
from bayes_body.workshop.simulation.sensor import Sensor, segment
from bayes_body.workshop.simulation.session_files import VideoWriter, write_mask
from bayes_body.workshop.simulation.surface import Mesh

# How many frames of a moving camera and of the person's motion are used to keep furniture out of the way; how many frames of a video are averaged.
LOOKED_AT, AVERAGED = 12, 30


class Background:
    """The empty scene of one camera: computed once if the camera stands still, in each frame if it moves."""

    def __init__(self, cameras: Sequence[CameraSpec], moves: bool, scene: Scene | EmptyScene):
        self._cameras, self._scene = cameras, scene
        self._still = scene if isinstance(scene, EmptyScene) else None if moves else scene.look(cameras[0])

    def empty(self, frame: int) -> EmptyScene:
        """The empty scene in a frame, without noise."""
        if self._still is not None:
            return self._still
        assert isinstance(self._scene, Scene)
        return self._scene.look(self._cameras[frame])


def backgrounds(rig: Rig, people: Sequence[Mapping[str, Float[np.ndarray, "frame 3"]]], options: Options) -> list[Background]:
    """The background of each camera, for the landmarks of the people who are filmed before it.

    Raises:
        InputError: a user's picture is missing or has a wrong size, or a moving camera has such a picture.
    """
    posed = rig.posed(len(people[0]["pelvis"]))
    moves = [path is not None for path in rig.path]
    if options.background is None:
        rng = np.random.default_rng((options.seed, 7))
        scene = Scene(build_room(rng, _clearance(posed, people), options.clutter))
        return [Background(cameras, moved, scene) for cameras, moved in zip(posed, moves, strict=True)]
    return [Background(cameras, moved, _from_picture(options.background, cameras[0], moved)) for cameras, moved in zip(posed, moves, strict=True)]


def _clearance(posed: Sequence[Sequence[CameraSpec]], people: Sequence[Mapping[str, Float[np.ndarray, "frame 3"]]]) -> Clearance:
    frames = _evenly(len(posed[0]), LOOKED_AT)
    cameras = np.array([-camera.rotation.T @ camera.translation_m for path in posed for camera in {id(path[k]): path[k] for k in frames}.values()])
    points = np.concatenate([track[frames] for landmarks in people for track in landmarks.values()])
    return Clearance(cameras, points[np.isfinite(points).all(axis=1)])


def _from_picture(folder: Path, camera: CameraSpec, moves: bool) -> EmptyScene:
    if moves:
        problem = f"camera '{camera.name}' moves"
        raise input_error(f"--background {folder}", problem, "cameras that do not move", "leave out the option, or the camera (--cameras)")
    path = find_background(folder, camera.name, camera.size_px)
    if is_image(path):
        picture = read_colour(path, camera.size_px).astype(np.float32)
    else:
        frames = _evenly(readable_frames(path, probe(path).frames), AVERAGED)
        picture = np.mean([read_video_frame(path, number, camera.size_px) for number in frames], axis=0, dtype=np.float32)
    # The floor of a user's picture is unknown, so the shadow falls wherever the floor's plane is visible.
    return EmptyScene(picture, np.ones(picture.shape[:2], bool))


def _evenly(frames: int, count: int) -> list[int]:
    return np.unique(np.linspace(0, frames - 1, min(count, frames)).round().astype(int)).tolist()


LIGHT = Light()
# Fraction of the floor's light that the person blocks, and width of the shadow's soft edge in pixels, for a picture with 640 columns.
SHADOW, SHADOW_PX, AT_COLUMNS = 0.42, 6.0, 640
# Frames of the empty scene: one second, filmed just before the recording.
EMPTY_FRAMES = 30


class Picture(NamedTuple):
    """A camera's picture of one frame.

    Attributes:
        image: blue, green, red.
        true_masks: where each person visibly covers more than half of a pixel.
        true_mask_of_all: where all people together do.
        mask: a segmenter's silhouette of all people; None if none was asked for.
    """

    image: UInt8[np.ndarray, "row column 3"]
    true_masks: Bool[np.ndarray, "person row column"]
    true_mask_of_all: Bool[np.ndarray, "row column"]
    mask: Bool[np.ndarray, "row column"] | None


class Camera:
    """A camera in each frame, its empty scene, and the segmenter of its pictures."""

    def __init__(self, posed: Sequence[CameraSpec], background: Background, sensor: Sensor, quality: Quality | None, key: tuple[int, ...]):
        self._posed, self._background, self._sensor, self._key = posed, background, sensor, key
        self._quality: Quality | None = quality

    def take(self, meshes: Sequence[Mesh], frame: int) -> Picture:
        """The picture of a frame with the people."""
        camera, empty = self._posed[frame], self._background.empty(frame)
        shadow = np.where(empty.floor, shadow_mask(merged(meshes), camera, LIGHT.direction, SHADOW_PX * camera.size_px[0] / AT_COLUMNS), 0)
        picture, coverages = rasterise_people(meshes, camera, _darkened(empty.picture, shadow), LIGHT)
        coverage = coverages.sum(axis=0)
        return Picture(self._sensor.read(picture, frame), coverages > 0.5, coverage > 0.5, self._segment(coverage, shadow, frame))

    def spec(self, frame: int) -> CameraSpec:
        """The camera in a frame."""
        return self._posed[frame]

    def take_empty(self, frame: int) -> UInt8[np.ndarray, "row column 3"]:
        """The picture without the person. Frames before the recording are negative."""
        return self._sensor.read(self._background.empty(max(frame, 0)).picture, frame)

    def _segment(
        self, coverage: Float[np.ndarray, "row column"], shadow: Float[np.ndarray, "row column"], frame: int
    ) -> Bool[np.ndarray, "row column"] | None:
        if self._quality is None:
            return None
        return segment(np.random.default_rng((*self._key, frame)), self._quality, coverage, shadow)


def _darkened(picture: Float[np.ndarray, "row column 3"], shadow: Float[np.ndarray, "row column"]) -> Float[np.ndarray, "row column 3"]:
    """The picture with the shadow applied."""
    x, y, width, height = cv2.boundingRect((shadow > 0).astype(np.uint8))
    region = slice(y, y + height), slice(x, x + width)
    darkened = picture.copy()
    darkened[region] *= 1 - SHADOW * shadow[region][..., None]
    return darkened


class Reel:
    """A camera's output files: its video, and its silhouettes if they are wanted."""

    def __init__(self, stack: ExitStack, folder: Path, camera: CameraSpec, fps: float, masks: Sequence[str]):
        """Open the files.

        Args:
            stack: closes the files.
            folder: the session's folder.
            camera: the camera.
            fps: frames per second.
            masks: the folder names for silhouettes.

        Raises:
            InputError: the files cannot be written.
        """
        self._video = stack.enter_context(VideoWriter(folder / video_name(camera.name), fps, camera.size_px))
        self._masks = {name: folder / mask_pattern(name, camera.name) for name in masks}
        for pattern in self._masks.values():
            make_folder(pattern.parent)

    def add(self, picture: Picture, frame: int) -> None:
        """Write a frame."""
        self._video.add(picture.image)
        for name, pattern in self._masks.items():
            mask = {TRUE_MASKS: picture.true_masks[0], TRUE_MASKS_OF_ALL: picture.true_mask_of_all}.get(name, picture.mask)
            if mask is not None:
                write_mask(pattern, frame, mask)


MASKS, TRUE_MASKS, TRUE_MASKS_OF_ALL = "masks", "true_masks", "true_masks_of_all"


def mask_pattern(kind: str, name: str) -> str:
    """The printf pattern of a camera's silhouettes, relative to the session's folder."""
    # Escape percent signs in a name: they are not the frame number.
    return f"{kind}/{name.replace('%', '%%')}/%06d.png"


def video_name(name: str) -> str:
    """A camera's video, relative to the session's folder."""
    return f"videos/{name}.mp4"


def empty_name(name: str) -> str:
    """A camera's video of the empty scene, relative to the session's folder."""
    return f"background/{name}.mp4"


def cameras(
    posed: Sequence[Sequence[CameraSpec]], grey: Sequence[bool], fps: float, scenes: Sequence[Background], options: Options, quality: Quality | None
) -> list[Camera]:
    """The cameras of a rig, each with its own sensor."""
    filming = []
    for number, (path, colourless, scene) in enumerate(zip(posed, grey, scenes, strict=True)):
        sensor = Sensor((options.seed, 11, number), len(path), fps, colourless, options.noise)
        filming.append(Camera(path, scene, sensor, quality, (options.seed, 13, number)))
    return filming


def film_empty(camera: Camera, path: Path, fps: float, size_px: tuple[int, int]) -> None:
    """Write the video of the empty scene, as the camera saw it just before the recording.

    Raises:
        InputError: it cannot be written.
    """
    with VideoWriter(path, fps, size_px) as video:
        for frame in range(-EMPTY_FRAMES, 0):
            video.add(camera.take_empty(frame))
