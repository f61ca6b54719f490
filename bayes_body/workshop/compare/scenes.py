"""Scenes with known truth for a model: a given recording, a rendered walk, or data drawn from the model itself.

A body with a pelvis walks in front of the four shipped cameras, drawn by a renderer that does not use the model. No recording shows an arm alone. For
an arm, and if a recording lacks the data of a likelihood, data are drawn from the model if its likelihoods are distributions over data.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import InputError, input_error
from bayes_body.base.files.atomic import make_folder, replacing
from bayes_body.base.files.shipped import definitions_folder
from bayes_body.base.geometry.camera import Camera
from bayes_body.base.shapes import Key
from bayes_body.initial import apply_first_pose, first_pose
from bayes_body.model.build import Model, build_model
from bayes_body.model.definition import Definition
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.observation.frames import read_frame
from bayes_body.recording.readers.rig import read_rig
from bayes_body.recording.session.read import load_session
from bayes_body.recording.session.session import CameraSpec, Session, View
from bayes_body.workshop.calibration.problem import Case, check_cases, draw_case, problem_of
from bayes_body.workshop.calibration.scene import model_in_a_room

RIG, FPS = "room_4", 60.0
TRUTH = "truth.npz"
# An arbitrary walker: build, clothes and stature.
PERSON, HEIGHT_M = 4, 1.76
# A body needs these markers to walk through a room.
ROOT = "pelvis"


class Scene(NamedTuple):
    """A model with the data that it is to follow.

    Attributes:
        session: cameras, frames and truth.
        model: with the session's first pose.
        kind: recording, rendered or drawn.
    """

    session: Session
    model: Model
    kind: str


class Scenes:
    """The scenes of one benchmark. What several rows share is computed once.

    Args:
        folder: for the scenes, as long as they are needed.
        frames: number of frames of each scene.
        seed: for the walk, the renderer's noise, and data drawn from models.
        session: folder of a recording that replaces all other scenes.
    """

    def __init__(self, folder: Path, frames: int, seed: int = 0, session: Path | None = None):
        self.folder, self.frames, self.seed, self.recording = folder, frames, seed, session
        self._made: dict[str, Scene | InputError] = {}

    def of(self, definition: Definition) -> Scene:
        """The scene of a model.

        Raises:
            InputError: there is none; the message gives the reason.
        """
        if definition.name not in self._made:
            try:
                self._made[definition.name] = self._make(definition)
            except InputError as error:
                self._made[definition.name] = error
        scene = self._made[definition.name]
        if isinstance(scene, InputError):
            raise scene
        return scene

    @cached_property
    def session(self) -> Session:
        """The recording, or the rendered walk."""
        return load_session(self.recording) if self.recording is not None else rendered(self.folder / "walk", self.frames, self.seed)

    def _make(self, definition: Definition) -> Scene:
        if self.recording is not None:
            return self._recorded(definition, "recording")
        if ROOT not in definition.body.markers:
            return self._drawn(definition)
        try:
            return self._recorded(definition, "rendered")
        except InputError:
            # For example, the likelihood reads keypoints, but no detector ran on this recording.
            if not_generative(build_model(definition, self.session)):
                raise
            return self._drawn(definition)

    def _recorded(self, definition: Definition, kind: str) -> Scene:
        model = build_model(definition, self.session)
        # Check that the recording has what the likelihoods read, before fitting the first pose.
        model.observe(read_frame(self.session, 0))
        return Scene(self.session, apply_first_pose(model, self.session, first_pose(model, self.session, "fitted")), kind)

    def _drawn(self, definition: Definition) -> Scene:
        model = model_in_a_room(definition)
        lacking = not_generative(model)
        if lacking:
            problem = f"its likelihood '{lacking[0]}' is not a distribution over data, and no recording shows the body '{definition.body_name}' alone"
            raise input_error(definition.name, problem, "data to follow", "give a recording of it with --session")
        return drawn(model, self.folder / definition.name, self.frames, jax.random.fold_in(jax.random.key(self.seed), 1))


def not_generative(model: Model) -> list[str]:
    """The likelihoods from which no data can be drawn."""
    return [factor.name for factor in model.factors if factor.side == "likelihood" and factor.simulate is None]


def rendered(folder: Path, frames: int, seed: int) -> Session:
    """A walk through the shipped room, drawn by the renderer.

    Raises:
        InputError: the folder cannot be written.
    """
    from bayes_body.workshop.learning.walking_cycle import load_cycle, walk
    from bayes_body.workshop.simulation.options import Options
    from bayes_body.workshop.simulation.person import build_person
    from bayes_body.workshop.simulation.session import simulate
    from bayes_body.workshop.simulation.staging import centred

    rig = read_rig(definitions_folder() / "rigs" / f"{RIG}.toml", FPS)
    landmarks = walk(load_cycle(), frames / FPS, FPS, height_m=HEIGHT_M, seed=seed)
    session, _ = simulate(centred(landmarks, rig.aim_m), rig, build_person(PERSON, HEIGHT_M), Options(seed=seed), folder, title="a rendered walk")
    return session


def drawn(model: Model, folder: Path, frames: int, key: Key) -> Scene:
    """A path drawn from the model's motion prior, with data drawn from its likelihoods.

    Raises:
        InputError: the model cannot be simulated, or the folder cannot be written.
    """
    case: Case = jax.device_get(jax.jit(draw_case, static_argnums=(1, 2))(key, problem_of(model), frames))
    check_cases(case.refused, case.unbounded)
    make_folder(folder)
    _write_truth(folder / TRUTH, model, np.asarray(case.path["pose"]))
    views = tuple(View(camera, images=_blank(folder, camera)) for camera in _cameras(model.rig))
    session = Session(folder, "data drawn from the model", "z", FPS, frames, 0, views, truth=TRUTH)
    observers = {name: _of_frame(data) for name, data in case.data.items()}
    first = jax.tree.map(jnp.asarray, dict(case.first))
    return Scene(session, replace(model, first=model.first.make_certain(first), observers=observers), "drawn")


def _of_frame(data: Any) -> Callable[[Any], Any]:
    return lambda frame: jax.tree.map(lambda leaf: leaf[frame.index], data)


def _write_truth(path: Path, model: Model, poses: Float[np.ndarray, "frame dof"]) -> None:
    """Write the markers that the body has; the others are unknown."""
    names = model.body.markers.names
    positions = np.full((len(poses), len(MARKERS), 3), np.nan)
    for frame, pose in enumerate(poses):
        by_name = dict(zip(names, np.asarray(model.markers(jnp.asarray(pose)), float), strict=True))
        positions[frame] = [by_name.get(name, [np.nan] * 3) for name in MARKERS]
    with replacing(path) as partial:
        np.savez(partial, markers=positions, names=np.array(MARKERS))


def _cameras(rig: Camera) -> list[CameraSpec]:
    """The cameras of a rig as plain numbers."""
    columns = [rig.size, rig.focal, rig.centre, rig.skew, rig.distortion, rig.rotation, rig.translation]
    cameras = []
    for index, camera in enumerate(zip(*(np.asarray(column, float) for column in columns), strict=True)):
        size, focal, centre, skew, distortion, rotation, translation = camera
        width, height = (round(extent) for extent in size)
        cameras.append(
            CameraSpec(f"C{index + 1}", (width, height), tuple(focal), tuple(centre), float(skew), tuple(distortion), rotation, translation)
        )
    return cameras


def _blank(folder: Path, camera: CameraSpec) -> str:
    """The pattern of a camera's images, one image for all frames: a tracker reads images, even if no likelihood uses them."""
    width, height = camera.size_px
    # An image with a single grey level would count as not seen.
    (folder / f"{camera.name}.pgm").write_bytes(b"P5 %d %d 255\n" % (width, height) + np.arange(width * height).astype(np.uint8).tobytes())
    # `%.0s` consumes the frame number and prints nothing.
    return f"{camera.name}%.0s.pgm"
