"""Film a simulated person who walks, for experiments on recordings with a known truth, and place the markers of their first frame as by hand."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from bayes_body.base.progress import Watch, unwatched
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.readers.mocap import landmarks, read_motion, resample
from bayes_body.recording.readers.rig import Rig
from bayes_body.recording.session.session import Session
from bayes_body.results.metrics.truth import no_truth, true_markers
from bayes_body.workshop.learning.walking_cycle import load_cycle, walk
from bayes_body.workshop.simulation.options import Options
from bayes_body.workshop.simulation.person import build_person
from bayes_body.workshop.simulation.session import simulate
from bayes_body.workshop.simulation.staging import Landmarks, centred, cut, scaled, stature_m

FPS, HAND_SD_M = 30.0, 0.015


def film(
    folder: Path, rig: Rig, frames: int, seed: int, motion: Path | None, title: str, watch: Watch = unwatched, radius_m: float | None = None
) -> Session:
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
    long_walk = captured_walk(motion, 2 * frames / rig.fps, seed, rig.fps)
    stretch = cut(long_walk, max(0, (len(long_walk["pelvis"]) - frames) // 2), frames)
    person = build_person(seed, stature_m(stretch))
    stretch = scaled(stretch, person.build.height_m / stature_m(stretch))
    stretch = centred(stretch if radius_m is None else bent_into_circle(stretch, radius_m), rig.aim_m)
    return simulate(stretch, rig, person, Options(seed=seed), folder, title=title, watch=watch)[0]


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


def placed_by_hand(session: Session, seed: int) -> dict[str, tuple[float, float, float]]:
    """Return the markers of frame 0 as someone places them by hand, as the paper's first pose was: the true ones with errors of HAND_SD_M."""
    truth = true_markers(session)
    if truth is None:
        raise no_truth(session)
    placed = truth[0] + np.random.default_rng(seed).normal(0.0, HAND_SD_M, truth[0].shape)
    x, y, z = placed.T.tolist()
    return dict(zip(MARKERS, zip(x, y, z, strict=True), strict=True))


def bent_into_circle(straight: Landmarks, radius_m: float) -> dict[str, Float[np.ndarray, "frame 3"]]:
    """Bend a straight walk into a circle: what was a way along the floor is an arc, and the body turns with it. Heights do not change."""
    pelvis = np.asarray(straight["pelvis"], float)
    ahead = pelvis[-1, :2] - pelvis[0, :2]
    ahead = ahead / np.linalg.norm(ahead)
    aside = np.array([-ahead[1], ahead[0]])
    angle = (pelvis[:, :2] - pelvis[0, :2]) @ ahead / radius_m
    places = {}
    for name, way in straight.items():
        offset = np.asarray(way, float)[:, :2] - pelvis[:, :2]
        # The pelvis keeps its distance from the line of walking.
        along, across = offset @ ahead, offset @ aside + (pelvis[:, :2] - pelvis[0, :2]) @ aside - radius_m
        turned = np.stack([along * np.cos(angle) - across * np.sin(angle), along * np.sin(angle) + across * np.cos(angle)], axis=1)
        places[name] = np.column_stack([turned @ np.stack([ahead, aside]), np.asarray(way, float)[:, 2]])
    return places
