r"""Track a walk by image motion, and compare it with the motion prior alone and with edges (Sidenbladh, Black & Fleet 2000, 7).

    python inference/papers/sidenbladh_2000/image_motion.py --path circle --moving --out RUN --json figures.json

Films a walk with one camera and tracks it three times with the particle filter. Image motion says how the body moves, not where it is, so that errors
add up; silhouettes and edges say where it is.

The absolute error of a frame is the mean distance of the markers of the mean body from the true ones. The relative error is the same after both
pelvises are put in one place. The drift is the slope of the absolute error over the frames, by least squares, times 50 frames.
"""

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

import bayes_body as bb
from bayes_body.base.errors import InputError
from bayes_body.base.files.shipped import definitions_folder
from bayes_body.density.factor import Factor
from bayes_body.model.build import Model
from bayes_body.model.definition import Definition
from bayes_body.model.likelihood.silhouette_edges import SilhouetteEdges
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.readers.rig import read_rig
from bayes_body.recording.session.session import Session
from bayes_body.results.metrics.truth import draws_against_truth, no_truth, true_markers
from bayes_body.results.posterior import markers, mean_pose
from bayes_body.tracking.draws import Draws

sys.path.append(str(Path(__file__).parents[1]))
from filmed_walk import FPS, film, placed_by_hand

PARTICLES = {"straight": 5000, "circle": 15_000}
RIGS, RADIUS_M, WITH_EDGES, DRIFT_FRAMES = {False: "side_1", True: "moving_1"}, 2.0, "image_motion_edges", 50
# A walk that turns follows the pelvis, which turns by more than on a straight way.
TURNING = {"heading_sd_deg": None, "orientation_sd_deg": 1.2}


class Tracks(NamedTuple):
    """Three tracks of one recording: by image motion, by the motion prior alone, and by image motion with silhouettes and edges."""

    tracked: Draws
    prior: Draws
    with_edges: Draws


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Track a walk by image motion.")
    parser.add_argument("--path", choices=PARTICLES, default="straight", help="the way that the person walks (%(default)s)")
    parser.add_argument("--moving", action="store_true", help="with a camera that is carried around the person")
    parser.add_argument("--out", type=Path, required=True, help="folder for the recording and the overlays")
    parser.add_argument("--json", type=Path, required=True, help="file for the figures")
    parser.add_argument("--motion", type=Path, help="a captured walk; by default the walking cycle that ships")
    parser.add_argument("--model", default="sidenbladh_2000_walking", help="a definition with image motion (%(default)s)")
    parser.add_argument("--frames", type=bb.whole_number(2), default=50, help="number of frames (%(default)s)")
    parser.add_argument("--particles", type=bb.whole_number(1), help="particles; by default 5000 on a straight way, 15000 on a circle")
    parser.add_argument("--seed", type=bb.whole_number(0), default=0, help="seed of the person, the room and the filters (%(default)s)")
    parser.add_argument("--quick", action="store_true", help="12 frames, 500 particles: a trial")
    return parser.parse_args()


def main() -> None:
    arguments = parse()
    bb.configure()
    frames = 12 if arguments.quick else arguments.frames
    particles = 500 if arguments.quick else arguments.particles or PARTICLES[arguments.path]
    turns = arguments.path == "circle"
    rig = replace(read_rig(definitions_folder() / "rigs" / f"{RIGS[arguments.moving]}.toml"), fps=FPS)
    film_options = frames, arguments.seed, arguments.motion, f"a walk, {arguments.path}", bb.watched("filming")
    session = film(arguments.out / "recording", rig, *film_options, RADIUS_M if turns else None)
    session = replace(session, initial_keypoints={}, initial_markers=placed_by_hand(session, arguments.seed))
    bb.save_session(session)
    tracks = track_three_times(session, arguments.model, particles, arguments.seed, turns)
    figures = {"path": arguments.path, "moving": arguments.moving, **motion_figures(session, tracks)}
    arguments.json.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    for key, value in figures.items():
        print(f"{key:<36}{value:.1f}" if isinstance(value, float) else f"{key:<36}{value}")
    for name, draws in tracks._asdict().items():
        bb.draw_overlay(session, draws, arguments.out / name)


def track_three_times(session: Session, model: str, particles: int, seed: int, turns: bool) -> Tracks:
    """Track a recording with the particle filter, each time from the same markers of the first frame.

    With silhouettes and edges, the body's lengths and outline are fitted to the first frame too.

    Args:
        session: the recording.
        model: the definition with image motion.
        particles: number of particles.
        seed: of the filters.
        turns: whether the person turns while walking, as on a circle. A prior `walking_cycle` then has the options TURNING; other priors stay.

    Raises:
        InputError: a definition or the first pose cannot be used.
    """
    by_motion, with_edges = (bb.load_definition(name) for name in (model, WITH_EDGES))
    if turns:
        by_motion, with_edges = turning(by_motion), turning(with_edges)
    # Without likelihoods the images say nothing.
    prior = replace(by_motion, likelihoods=())
    # With silhouettes, the size in the image says how far away the person is. So the body has the size of the person in the first frame.
    measured = replace(session, fit_lengths=True, fit_outline=not session.moves)

    def follow(definition: Definition, recording: Session = session) -> Draws:
        loaded = with_first_area(bb.load_model(definition, recording, lambda line: None), recording)
        return bb.track(jax.random.key(seed), recording, loaded, bb.kernels.sir(), particles=particles)

    return Tracks(follow(by_motion), follow(prior), follow(with_edges, measured))


def with_first_area(model: Model, session: Session) -> Model:
    """Return the model whose silhouettes have the area of the first frame's, where the pose is known. A body without clothes and neck covers less.

    Raises:
        InputError: the first frame cannot be read.
    """
    if session.moves or not any(isinstance(factor.log_potential, SilhouetteEdges) for factor in model.factors):
        return model
    maps = model.observe(bb.read_frame(session, 0, with_before=True))

    def matched(factor: Factor) -> Factor:
        potential = factor.log_potential
        if not isinstance(potential, SilhouetteEdges):
            return factor
        return replace(factor, log_potential=potential.matched_to(maps[factor.name], model.first_pose))

    return replace(model, factors=tuple(matched(factor) for factor in model.factors))


def turning(definition: Definition) -> Definition:
    """Return the definition for a person who turns. Other priors than the walking cycle have no heading."""
    if definition.dynamics.kind != "walking_cycle":
        return definition
    options = definition.dynamics.options.model_copy(update=TURNING)
    return replace(definition, dynamics=replace(definition.dynamics, options=options))


def motion_figures(session: Session, tracks: Tracks) -> dict[str, Any]:
    """Return the figures of the comparison.

    Raises:
        InputError: the session has no truth.
    """
    (absolute, relative), (prior, _), (edges, relative_edges) = (errors(session, draws) for draws in tracks)
    timing = tracks.tracked.timing
    return {
        "relative_error_mm": 1000 * float(relative.mean()),
        "absolute_error_mm": 1000 * float(absolute.mean()),
        "prior_only_absolute_error_mm": 1000 * float(prior.mean()),
        "drift_mm_per_50_frames": drift_mm(absolute),
        "absolute_error_with_edges_mm": 1000 * float(edges.mean()),
        "relative_error_with_edges_mm": 1000 * float(relative_edges.mean()),
        "drift_with_edges_mm_per_50_frames": drift_mm(edges),
        "effective_particles": float(np.median([frame.info.ess for frame in tracks.tracked.frames])),
        "frames": len(absolute),
        "particles": tracks.tracked.frames[0].log_weights.shape[1],
        "seconds_per_frame": (timing.total - timing.compile) / len(absolute),
    }


def errors(session: Session, draws: Draws) -> tuple[Float[np.ndarray, " frame"], Float[np.ndarray, " frame"]]:
    """Return the absolute and the relative error of each frame, metres, mean over the runs."""
    against = draws_against_truth(session, draws)
    if against is None:
        raise no_truth(session)
    return against.plain.frame_error.mean(axis=1), against.plain.relative.mean(axis=1)


def track_by_mapping(session: Session, model: str, mapping: str, particles: int, seed: int) -> Draws:
    """Track a recording by image motion with the particle filter, where surfaces are mapped by their cylinder or by a plane that faces the camera.

    Args:
        session: the recording.
        model: the definition with image motion.
        mapping: "cylinder" or "plane".
        particles: number of particles.
        seed: of the filter.

    Raises:
        InputError: the definition or the first pose cannot be used.
    """
    definition = bb.load_definition(model)
    terms = tuple(replace(term, options=term.options.model_copy(update={"mapping": mapping})) for term in definition.likelihoods)
    loaded = bb.load_model(replace(definition, likelihoods=terms), session, lambda line: None)
    return bb.track(jax.random.key(seed), session, loaded, bb.kernels.sir(), particles=particles)


def heading_error_deg(session: Session, draws: Draws) -> float:
    """Return the angle in the ground plane between the mean body's line of the hips and the true one in the last frame, degrees; mean of the runs.

    Raises:
        InputError: the session has no truth.
    """
    truth, names, up = true_markers(session), draws.model.body.markers.names, "xyz".index(session.up)
    if truth is None:
        raise no_truth(session)
    places = markers(draws.model, mean_pose(draws.frames[-1], draws.model))
    true = truth[len(draws.frames) - 1]
    hips = places[:, names.index("l_hip")] - places[:, names.index("r_hip")]
    true_hips = true[MARKERS.index("l_hip")] - true[MARKERS.index("r_hip")]
    level, true_level = np.delete(hips, up, axis=1), np.delete(true_hips, up)
    cosine = level @ true_level / (np.linalg.norm(level, axis=1) * np.linalg.norm(true_level))
    return float(np.rad2deg(np.arccos(np.clip(cosine, -1, 1))).mean())


def drift_mm(error_m: Float[np.ndarray, " frame"]) -> float:
    """Return the slope of an error over the frames, mm per 50 frames; 0 for one frame."""
    return 1000 * DRIFT_FRAMES * float(np.polyfit(np.arange(len(error_m)), error_m, 1)[0]) if len(error_m) > 1 else 0.0


if __name__ == "__main__":
    try:
        main()
    except (InputError, OSError) as error:
        print(error, file=sys.stderr)
        sys.exit(2)
