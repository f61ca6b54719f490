"""A room for checking a model without a recording: the shipped rig of four cameras, aimed at the body; and a first call of a user's plugins.

The body appears small in the images, a quarter as large as it could be. Then the posterior is about as wide as the motion prior, and a few thousand
particles are enough. With nearer cameras the check would be equally valid, but a sampler from the prior would need millions. The cameras of a rig
that the user gives are not moved.

Each term of a user's plugins is called once before many replications run in other processes. Its faults become sentences that name its line.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from bayes_body.base.errors import input_error
from bayes_body.base.files.shipped import definitions_folder
from bayes_body.density.density import Density
from bayes_body.density.factor import Particles
from bayes_body.density.kernel import Kernel
from bayes_body.model.body.placement import POSE
from bayes_body.model.build import Model, build_model
from bayes_body.model.definition import Definition
from bayes_body.model.plugins.load import check_own_factors
from bayes_body.model.plugins.terms import OwnKernel, check_result
from bayes_body.recording.readers.rig import read_rig
from bayes_body.recording.session.session import CameraSpec, Session, View
from bayes_body.workshop.calibration.problem import draw_data, draw_path, point_mass, problem_of

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


# Particles of a first call: whatever their number, the same code runs.
FEW = 8


def probe(model: Model, kernel: Kernel, runs: bool = True) -> None:
    """Call each term that is not built in once.

    Without likelihoods that can be simulated there are no data: then only the prior's terms have values, and a kernel is traced on the prior.

    Args:
        model: the model with the terms.
        kernel: a kernel; one that is not built in is called.
        runs: whether it is also run on data, so that its numbers can be checked; else it is only traced.

    Raises:
        InputError: a term fails, or returns something else than it must.
    """
    particles = model.start(FEW)
    density = _simulated(model, particles) or _prior(model, particles)
    check_own_factors(density, model.initial)
    if not isinstance(kernel, OwnKernel):
        return
    key = jax.random.key(0)
    if runs and len(density.factors) == len(model.factors):
        next_particles, _ = jax.device_get(jax.jit(kernel)(key, particles, density))
        check_result(kernel, next_particles, 0)
    else:
        jax.eval_shape(kernel, key, particles, density)


def check_effective(source: str, figures: np.ndarray) -> None:
    """Check that what was computed from a kernel's weights are numbers, (repetition, figure).

    Raises:
        InputError: one is NaN, as after log-weights that are NaN.
    """
    if np.isnan(figures).any():
        problem = f"in {np.isnan(figures).any(axis=-1).mean():.0%} of the repetitions its log-weights are NaN"
        raise input_error(source, problem, "normalised log-weights", "where no particle explains the data, return equal ones and set `lost`")


def _prior(model: Model, particles: Particles) -> Density:
    return Density(model.transition, tuple(factor for factor in model.factors if factor.side != "likelihood"), {}, particles)


def _simulated(model: Model, particles: Particles) -> Density | None:
    """The density of a frame that is drawn from the model; None if it cannot be drawn."""
    likelihoods = [factor for factor in model.factors if factor.side == "likelihood"]
    if model.body.variable != POSE or any(factor.simulate is None for factor in likelihoods):
        return None
    problem = replace(problem_of(model), factors=tuple(likelihoods))

    def data(key: Any) -> Any:
        path = draw_path(key, problem, point_mass(problem.first), 1)
        return jax.tree.map(lambda leaf: leaf[0], draw_data(key, problem, path))

    return Density(model.transition, model.factors, jax.jit(data)(jax.random.key(0)), particles)
