"""What a bystander does to a track by silhouettes: `python tests/bench/bystander.py FOLDER [--frames N] [--seeds 1 2] [--model M] [--json F]`.

Two simulated people walk side by side, so that their outlines touch in two of four views, which the true silhouettes confirm. One of them is tracked
in turn: filmed alone; with the other one, whom nobody knows; the same with `figures = "near_body"`; with the other one, whose keypoints are in the
files; and alone with `near_body`, which is to change nothing (`--ways` chooses). Read the ratios of the errors to that without a bystander.
`--rig humaneva_7 --cameras BW1,BW2,BW3,BW4` films with other cameras; with `--view 1` outlines touch in the second view and the fourth.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import bayes_body as bb

# Before the other imports, which may touch JAX.
bb.configure(devices=1)

import cv2  # noqa: E402
import jax  # noqa: E402
import numpy as np  # noqa: E402

from bayes_body.base.files.shipped import definitions_folder  # noqa: E402
from bayes_body.recording.evidence.markers import MARKERS  # noqa: E402
from bayes_body.recording.readers.images import read_mask  # noqa: E402
from bayes_body.recording.readers.keypoints.candidates import Bystanders  # noqa: E402
from bayes_body.recording.readers.keypoints.series import KeypointSeries, write_series  # noqa: E402
from bayes_body.recording.readers.rig import read_rig  # noqa: E402
from bayes_body.recording.session.read import load_session  # noqa: E402
from bayes_body.results.metrics.truth import draws_against_truth  # noqa: E402
from bayes_body.runs.other_figures import observations_near_body  # noqa: E402
from bayes_body.tracking.track import track  # noqa: E402
from bayes_body.workshop.learning.walking_cycle import load_cycle, walk  # noqa: E402
from bayes_body.workshop.simulation.film import TRUE_MASKS, TRUE_MASKS_OF_ALL, mask_pattern  # noqa: E402
from bayes_body.workshop.simulation.options import Options  # noqa: E402
from bayes_body.workshop.simulation.person import build_person  # noqa: E402
from bayes_body.workshop.simulation.session import Bystander, simulate  # noqa: E402
from bayes_body.workshop.simulation.staging import centred, scaled, stature_m  # noqa: E402
from bayes_body.workshop.simulation.visibility import detected  # noqa: E402

# Where the other one walks, from the tracked person: so many metres away, and so many degrees beside the line of sight of a camera of four that stand
# in the corners. It is 45 cm beside as this camera and the one across see it, and a metre as the others do.
AWAY_M, BESIDE_DEG = 1.1, 23.7
# A network's keypoints: standard deviation, pixels.
KEYPOINT_SD_PX = 3.0
WAYS = ("alone", "with a bystander", "with near_body", "with his keypoints", "alone with near_body")


def walker(rig, frames, seed):
    """A simulated person, and where the landmarks of his walk are."""
    cycle = load_cycle()
    landmarks = walk(cycle, frames / rig.fps, rig.fps, seed=seed, height_m=cycle.height_m)
    landmarks = {name: track[:frames] for name, track in landmarks.items()}
    stature = stature_m(landmarks)
    person = build_person(seed, stature)
    return person, centred(scaled(landmarks, person.build.height_m / stature), rig.aim_m)


def place_beside(rig, view):
    """Where the other one walks from the tracked person, metres; `view` is the number of a camera that sees their outlines touch."""
    camera = rig.cameras[view]
    towards = -camera.rotation.T @ camera.translation_m - rig.aim_m
    angle = np.arctan2(towards[1], towards[0]) + np.deg2rad(BESIDE_DEG)
    return AWAY_M * np.array([np.cos(angle), np.sin(angle), 0.0])


def points_of(rig, landmarks, seed):
    """Keypoints (camera, frame, marker, 3) as a network gives them; NaN where there is none."""
    frames = len(landmarks["pelvis"])
    points = np.full((len(rig.cameras), frames, len(MARKERS), 3), np.nan)
    for c, camera in enumerate(rig.cameras):
        rng = np.random.default_rng((seed, c))
        for frame in range(frames):
            for name, point in detected(rng, camera, {name: landmarks[name][frame] for name in MARKERS}, KEYPOINT_SD_PX).items():
                points[c, frame, MARKERS.index(name)] = point
    return points


def with_others(session, rig, landmarks, other_landmarks, seed):
    """The session with keypoint files: the subject's, and the other one's as those of another person."""
    subject_points, other_points = points_of(rig, landmarks, seed), points_of(rig, other_landmarks, seed + 1)
    views = []
    for view, points, other in zip(session.views, subject_points, other_points, strict=True):
        name = f"keypoints/{view.camera.name}.npz"
        others = Bystanders(other.astype(np.float32), np.ones(len(other), np.int64))
        write_series(session.folder / name, KeypointSeries(points, MARKERS, 0, None, others))
        views.append(replace(view, keypoints=name))
    return replace(session, views=tuple(views))


def sessions(folder, rig, frames, seed, view):
    """The session of each of the ways."""
    person, landmarks = walker(rig, frames, seed)
    other, other_landmarks = walker(rig, frames, seed + 100)
    shift = place_beside(rig, view) + (landmarks["pelvis"] - other_landmarks["pelvis"]).mean(axis=0) * [1, 1, 0]
    other_landmarks = {name: track + shift for name, track in other_landmarks.items()}
    options, filmed = Options(seed=seed, true_masks=True), []
    for name, bystanders in (("alone", ()), ("crowd", (Bystander(other_landmarks, other),))):
        place = folder / f"{seed}_{view}_{name}"
        if not (place / "session.toml").exists():
            simulate(landmarks, rig, person, options, place, bystanders=bystanders)
        filmed.append(load_session(place))
    alone, crowd = filmed
    return alone, crowd, near_body(crowd), with_others(crowd, rig, landmarks, other_landmarks, seed), near_body(alone)


def near_body(session):
    """The session in which the body tells whose a figure is."""
    return replace(session, segmentation=replace(session.segmentation, figures="near_body"))


def mean_error_mm(session, model_name, frames, seed):
    """Track the session, and return the mean distance of the markers from the truth, mm."""
    model, store = bb.load_model(model_name, session, show=lambda _: None), []
    arriving = observations_near_body(session, model, model.kernel(), range(frames), store)
    draws = track(jax.random.key(seed), session, model, model.kernel(), frames=frames, into=store, arriving=arriving)
    return 1000 * float(draws_against_truth(session, draws).plain.frame_error.mean())


def contacts(alone, crowd):
    """For each camera the share of frames in which outlines touch, and the share of the tracked person that the other one hides."""
    rows = {}
    for camera in (view.camera for view in crowd.views):
        single, subject, people = (
            [read_mask(session.folder / (mask_pattern(kind, camera.name) % frame), camera.size_px) for frame in range(crowd.frames)]
            for session, kind in ((alone, TRUE_MASKS), (crowd, TRUE_MASKS), (crowd, TRUE_MASKS_OF_ALL))
        )
        touches = [is_one_figure(mask, everyone) for mask, everyone in zip(subject, people, strict=True)]
        rows[camera.name] = float(np.mean(touches)), 1 - np.sum(subject) / np.sum(single)
    return rows


def is_one_figure(subject, people):
    """Whether a figure of the silhouette of all people has the subject and the other one in it."""
    labels = cv2.connectedComponents(people.astype(np.uint8))[1]
    return bool(set(labels[subject]) & set(labels[people & ~subject]) - {0})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="folder to film into")
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--model", default="silhouettes")
    parser.add_argument("--ways", nargs="+", default=WAYS, choices=WAYS)
    parser.add_argument("--rig", default="room_4")
    parser.add_argument("--cameras", help="four of the rig's, in the order in which they stand around the room")
    parser.add_argument("--view", type=int, default=0, choices=range(4), help="camera that sees the outlines touch, and the one across")
    parser.add_argument("--json", type=Path, help="write the figures there, too")
    options = parser.parse_args()
    rig = read_rig(definitions_folder() / "rigs" / f"{options.rig}.toml")
    rig = rig.select(options.cameras.split(",")) if options.cameras else rig
    rows = []
    for seed in options.seeds:
        errors, filmed = {}, sessions(options.folder, rig, options.frames, seed, options.view)
        touching = contacts(filmed[0], filmed[1])
        print(f"seed {seed}: " + "; ".join(f"{name} touches {share:.0%}, hides {part:.1%}" for name, (share, part) in touching.items()), flush=True)
        for way, session in zip(WAYS, filmed, strict=True):
            if way in options.ways:
                errors[way] = mean_error_mm(session, options.model, options.frames, seed)
                ratio = f", {errors[way] / errors[WAYS[0]]:.2f} of alone" if WAYS[0] in errors else ""
                print(f"seed {seed}, {way}: {errors[way]:.1f} mm{ratio}", flush=True)
        rows.append({"seed": seed, **errors, "touches and hides": touching})
    if options.json:
        options.json.write_text(json.dumps(rows, indent=2))


if __name__ == "__main__":
    main()
