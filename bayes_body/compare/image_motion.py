r"""Tracking by image motion, compared with the motion prior alone and with edges too, on a filmed walk (Sidenbladh, Black & Fleet 2000, 7).

The absolute error of a frame is the mean distance of the markers of the mean body from the true ones; the relative error is the same after both
pelvises are put in one place. The drift is the slope of the absolute error over the frames, by least squares, times 50 frames.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from bayes_body.evidence.markers import MARKERS
from bayes_body.files.shipped import definitions_folder
from bayes_body.initial import load_model
from bayes_body.kernels import particle_filter
from bayes_body.learning.walking_cycle import load_cycle, walk
from bayes_body.metrics.truth import draws_against_truth, no_truth, true_markers
from bayes_body.model.build import Model
from bayes_body.model.definition import Definition, load_definition
from bayes_body.recording.mocap import landmarks, read_motion, resample
from bayes_body.recording.rig import Rig, read_rig
from bayes_body.session.read import save_session
from bayes_body.session.session import Session
from bayes_body.simulation.options import Options
from bayes_body.simulation.person import build_person
from bayes_body.simulation.session import simulate
from bayes_body.simulation.staging import Landmarks, centred, cut, scaled, stature_m
from bayes_body.tracking.draws import Draws
from bayes_body.tracking.track import track
from bayes_body.view.progress import Watch, unwatched

type WalkPath = Literal["straight", "circle"]

STILL, MOVING, FPS, RADIUS_M, HAND_SD_M = "side_1", "moving_1", 30.0, 2.0, 0.015
MODEL, WITH_EDGES = "sidenbladh_2000_walking", "image_motion_edges"
DRIFT_FRAMES = 50
# A walk that turns follows the pelvis, which turns by more than on a straight way.
TURNING = {"heading_sd_deg": None, "orientation_sd_deg": 1.2}


class Compared(NamedTuple):
    """Three tracks of one recording: by image motion, by the motion prior alone, and by image motion with silhouettes and edges."""

    tracked: Draws
    prior: Draws
    with_edges: Draws


def film_walk(
    folder: Path, path: WalkPath, moving: bool, frames: int = DRIFT_FRAMES, seed: int = 0, motion: Path | None = None, watch: Watch = unwatched
) -> Session:
    """Film a walk in a cluttered room with one camera, 30 frames per second, and write the session.

    Args:
        folder: the session's folder.
        path: `circle` bends a straight walk into a circle of RADIUS_M.
        moving: whether the camera is carried around the person.
        frames: number of frames.
        seed: of the person, the room and the noise.
        motion: a captured walk; by default the walking cycle that ships.
        watch: wraps the frames to show progress.

    Raises:
        InputError: the folder already holds a session, or the motion cannot be read or is too short.
    """
    rig = replace(read_rig(definitions_folder() / "rigs" / f"{MOVING if moving else STILL}.toml"), fps=FPS)
    session = film(folder, rig, frames, seed, motion, f"a walk, {path}", watch, RADIUS_M if path == "circle" else None)
    session = replace(session, initial_keypoints={}, initial_markers=by_hand(session, seed))
    save_session(session)
    return session


def film(folder: Path, rig: Rig, frames: int, seed: int, motion: Path | None, title: str, watch: Watch, radius_m: float | None = None) -> Session:
    """Film the middle of a walk with a rig, and write the session.

    Args:
        folder: the session's folder.
        rig: the cameras.
        frames: number of frames.
        seed: of the person, the room and the noise.
        motion: a captured walk; None: the walking cycle that ships.
        title: of the session.
        watch: wraps the frames to show progress.
        radius_m: bends the walk into a circle; None: it stays straight.

    Raises:
        InputError: the folder already holds a session, or the motion cannot be read or is too short.
    """
    whole = captured_walk(motion, 2 * frames / rig.fps, seed, rig.fps)
    chosen = cut(whole, max(0, (len(whole["pelvis"]) - frames) // 2), frames)
    person = build_person(seed, stature_m(chosen))
    chosen = scaled(chosen, person.build.height_m / stature_m(chosen))
    chosen = centred(chosen if radius_m is None else on_circle(chosen, radius_m), rig.aim_m)
    return simulate(chosen, rig, person, Options(seed=seed), folder, title=title, watch=watch)[0]


def captured_walk(motion: Path | None, seconds: float, seed: int, fps: float = FPS) -> Landmarks:
    """Return the landmarks of a captured walk, or of the walking cycle that ships, metres.

    Args:
        motion: the captured walk; None: the cycle.
        seconds: how long the walk by the cycle is.
        seed: of the walk by the cycle.
        fps: frames per second.

    Raises:
        InputError: the motion cannot be read.
    """
    if motion:
        return landmarks(resample(read_motion(motion), fps))
    cycle = load_cycle()
    return walk(cycle, seconds, fps, seed=seed, height_m=cycle.height_m)


def by_hand(session: Session, seed: int) -> dict[str, tuple[float, float, float]]:
    """Return the markers of frame 0 as someone places them by hand, as the paper's first pose was: the true ones with errors of HAND_SD_M."""
    truth = true_markers(session)
    if truth is None:
        raise no_truth(session)
    placed = truth[0] + np.random.default_rng(seed).normal(0.0, HAND_SD_M, truth[0].shape)
    x, y, z = placed.T.tolist()
    return dict(zip(MARKERS, zip(x, y, z, strict=True), strict=True))


def on_circle(straight: Landmarks, radius_m: float) -> dict[str, Float[np.ndarray, "frame 3"]]:
    """Bend a straight walk into a circle: what was a way along the floor is an arc, and the body turns with it. Heights do not change."""
    pelvis = np.asarray(straight["pelvis"], float)
    ahead = pelvis[-1, :2] - pelvis[0, :2]
    ahead = ahead / np.linalg.norm(ahead)
    aside = np.array([-ahead[1], ahead[0]])
    angle = (pelvis[:, :2] - pelvis[0, :2]) @ ahead / radius_m
    bent = {}
    for name, way in straight.items():
        away = np.asarray(way, float)[:, :2] - pelvis[:, :2]
        # The pelvis keeps its distance from the line of walking.
        along, across = away @ ahead, away @ aside + (pelvis[:, :2] - pelvis[0, :2]) @ aside - radius_m
        turned = np.stack([along * np.cos(angle) - across * np.sin(angle), along * np.sin(angle) + across * np.cos(angle)], axis=1)
        bent[name] = np.column_stack([turned @ np.stack([ahead, aside]), np.asarray(way, float)[:, 2]])
    return bent


def uniform(definition: Definition) -> Definition:
    """Return a definition without likelihoods: the images say nothing."""
    return replace(definition, likelihoods=())


def compare_walk(
    session: Session,
    particles: int,
    seed: int = 0,
    model: str = MODEL,
    with_edges: str = WITH_EDGES,
    frames: int | None = None,
    turns: bool = False,
) -> Compared:
    """Track a recording three times with the particle filter, from the same first pose.

    Args:
        session: the recording.
        particles: number of particles.
        seed: of the filters.
        model: the definition with image motion.
        with_edges: the definition with image motion and edges.
        frames: number of frames; all by default.
        turns: whether the person turns while walking, as on a circle. A prior `walking_cycle` then has the options TURNING; other priors stay.

    Raises:
        InputError: a definition or the first pose cannot be used.
    """
    definition, edges = (load_definition(name) if not turns else _turning(load_definition(name)) for name in (model, with_edges))

    def followed(model: Model) -> Draws:
        return track(jax.random.key(seed), session, model, particle_filter.build_kernel(), particles, frames=frames)

    return Compared(*(followed(load_model(each, session, lambda line: None)) for each in (definition, uniform(definition), edges)))


def _turning(definition: Definition) -> Definition:
    # Other motion priors have no heading.
    if definition.dynamics.kind != "walking_cycle":
        return definition
    options = definition.dynamics.options.model_copy(update=TURNING)
    return replace(definition, dynamics=replace(definition.dynamics, options=options))


def motion_figures(session: Session, found: Compared) -> dict[str, Any]:
    """Return the figures of the comparison.

    Raises:
        InputError: the session has no truth.
    """
    errors = [_errors(session, draws) for draws in found]
    (tracked, relative), (prior, _), (edges, relative_edges) = errors
    timing = found.tracked.timing
    return {
        "relative_error_mm": 1000 * float(relative.mean()),
        "absolute_error_mm": 1000 * float(tracked.mean()),
        "prior_only_absolute_error_mm": 1000 * float(prior.mean()),
        "drift_mm_per_50_frames": drift_mm(tracked),
        "absolute_error_with_edges_mm": 1000 * float(edges.mean()),
        "relative_error_with_edges_mm": 1000 * float(relative_edges.mean()),
        "drift_with_edges_mm_per_50_frames": drift_mm(edges),
        "effective_particles": float(np.median([frame.info.ess for frame in found.tracked.frames])),
        "frames": len(tracked),
        "particles": found.tracked.frames[0].log_weights.shape[1],
        "seconds_per_frame": (timing.total - timing.compile) / len(tracked),
    }


def drift_mm(error_m: Float[np.ndarray, " frame"]) -> float:
    """Return the slope of an error over the frames, mm per 50 frames; 0 for one frame."""
    return 1000 * DRIFT_FRAMES * float(np.polyfit(np.arange(len(error_m)), error_m, 1)[0]) if len(error_m) > 1 else 0.0


def _errors(session: Session, draws: Draws) -> tuple[Float[np.ndarray, " frame"], Float[np.ndarray, " frame"]]:
    """Return the absolute and the relative error of each frame, metres, mean over the runs."""
    found = draws_against_truth(session, draws)
    if found is None:
        raise no_truth(session)
    return found.plain.frame_error.mean(axis=1), found.plain.relative.mean(axis=1)
