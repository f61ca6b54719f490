"""What a camera sees without the person: a drawn room, or a user's picture of an empty scene."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import input_error
from bayes_body.recording.readers.images import is_image, read_colour
from bayes_body.recording.readers.rig import Rig
from bayes_body.recording.readers.sources import find_background
from bayes_body.recording.readers.video import probe, read_video_frame, readable_frames
from bayes_body.recording.session.session import CameraSpec
from bayes_body.workshop.simulation.options import Options
from bayes_body.workshop.simulation.scene import EmptyScene, Scene
from bayes_body.workshop.simulation.scene_room import Clearance, build_room

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


def backgrounds(rig: Rig, landmarks: Mapping[str, Float[np.ndarray, "frame 3"]], options: Options) -> list[Background]:
    """The background of each camera.

    Raises:
        InputError: a user's picture is missing or has a wrong size, or a moving camera has such a picture.
    """
    posed = rig.posed(len(landmarks["pelvis"]))
    moves = [path is not None for path in rig.path]
    if options.background is None:
        rng = np.random.default_rng((options.seed, 7))
        scene = Scene(build_room(rng, _clearance(posed, landmarks), options.clutter))
        return [Background(cameras, moved, scene) for cameras, moved in zip(posed, moves, strict=True)]
    return [Background(cameras, moved, _from_picture(options.background, cameras[0], moved)) for cameras, moved in zip(posed, moves, strict=True)]


def _clearance(posed: Sequence[Sequence[CameraSpec]], landmarks: Mapping[str, Float[np.ndarray, "frame 3"]]) -> Clearance:
    frames = _evenly(len(posed[0]), LOOKED_AT)
    cameras = np.array([-camera.rotation.T @ camera.translation_m for path in posed for camera in {id(path[k]): path[k] for k in frames}.values()])
    points = np.concatenate([track[frames] for track in landmarks.values()])
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
