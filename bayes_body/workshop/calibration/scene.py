"""A room for checking a model without a recording: the shipped rig of four cameras, aimed at the body.

The body appears small in the images, a quarter as large as it could be. Then the posterior is about as wide as the motion prior, and a few thousand
particles are enough. With nearer cameras the check would be equally valid, but a sampler from the prior would need millions. The cameras of a rig
that the user gives are not moved.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from bayes_body.base.files.shipped import definitions_folder
from bayes_body.model.build import Model, build_model
from bayes_body.model.definition import Definition
from bayes_body.recording.readers.rig import read_rig
from bayes_body.recording.session.session import CameraSpec, Session, View

RIG = "room_4"
# The body extends beyond its markers (a hand beyond the wrist), and moves.
REACH = 1.6
# The body's extent, as a fraction of half the smaller side of an image.
FILLED = 0.225


def model_in_a_room(definition: Definition, rig: Path | None = None) -> Model:
    """The model with the cameras of a rig, without a recording.

    Args:
        definition: the definition of the model.
        rig: file of the rig; default: the shipped one, aimed at the body.

    Raises:
        InputError: the rig cannot be read.
    """
    room_rig = read_rig(definitions_folder() / "rigs" / f"{RIG}.toml" if rig is None else rig)
    model = build_model(definition, _session(room_rig.fps, room_rig.cameras))
    if rig is not None:
        return model
    markers = np.asarray(model.markers(model.initial[model.body.variable]), float)
    centre = (markers.min(axis=0) + markers.max(axis=0)) / 2
    reach = REACH * float(np.linalg.norm(markers - centre, axis=1).max())
    return build_model(definition, _session(room_rig.fps, tuple(_moved(camera, centre, reach) for camera in room_rig.cameras)))


def _moved(camera: CameraSpec, centre: np.ndarray, reach: float) -> CameraSpec:
    """The camera with its direction, on a line through the body's centre, at the distance that `FILLED` gives."""
    half = min(camera.size_px) / 2
    distance = reach * min(camera.focal_px) / (FILLED * half)
    return replace(camera, translation_m=-camera.rotation @ centre + np.array([0.0, 0.0, distance]))


def _session(fps: float, cameras: tuple[CameraSpec, ...]) -> Session:
    views = tuple(View(camera, images=f"unused{index}_%04d.png") for index, camera in enumerate(cameras))
    return Session(Path(), "a room without a recording", "z", fps, 1, 0, views)
