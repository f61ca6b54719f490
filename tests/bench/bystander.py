"""What a bystander does to a track by silhouettes: `python tests/bench/bystander.py FOLDER [--frames N] [--seeds 1 2] [--model M] [--json F]`.

Two simulated people walk side by side, so that their outlines touch in two of four views. One of them is tracked three ways: filmed alone; with the
other one, whom nobody knows; and with the other one, whose keypoints are in the files. Read the ratios of the errors to that without a bystander.
"""

import argparse
import json
from dataclasses import dataclass, replace
from pathlib import Path

import bayes_body as bb

# Before the other imports, which may touch JAX.
bb.configure(devices=1)

import jax  # noqa: E402
import numpy as np  # noqa: E402

from bayes_body.base.files.shipped import definitions_folder  # noqa: E402
from bayes_body.recording.evidence.markers import MARKERS  # noqa: E402
from bayes_body.recording.readers.keypoints.candidates import Bystanders  # noqa: E402
from bayes_body.recording.readers.keypoints.series import KeypointSeries, write_series  # noqa: E402
from bayes_body.recording.readers.rig import read_rig  # noqa: E402
from bayes_body.recording.session.read import load_session  # noqa: E402
from bayes_body.results.metrics.truth import draws_against_truth  # noqa: E402
from bayes_body.tracking.track import track  # noqa: E402
from bayes_body.workshop.learning.walking_cycle import load_cycle, walk  # noqa: E402
from bayes_body.workshop.simulation.options import Options  # noqa: E402
from bayes_body.workshop.simulation.person import Performance, Person, build_person  # noqa: E402
from bayes_body.workshop.simulation.session import simulate  # noqa: E402
from bayes_body.workshop.simulation.staging import centred, scaled, stature_m  # noqa: E402
from bayes_body.workshop.simulation.surface import Mesh  # noqa: E402
from bayes_body.workshop.simulation.visibility import detected  # noqa: E402

# Where the other one walks: 45 cm beside the tracked person as the first and the third camera of the rig see it, and a metre as the others do.
BESIDE_M = 1.1 * np.array([np.cos(np.deg2rad(64.0)), np.sin(np.deg2rad(64.0)), 0.0])
# A network's keypoints: standard deviation, pixels.
KEYPOINT_SD_PX = 3.0
WAYS = ("alone", "with a bystander", "with his keypoints")


@dataclass(frozen=True)
class Together:
    """Two performances in one scene, with the interface of one."""

    performances: tuple[Performance, Performance]

    def __len__(self) -> int:
        return len(self.performances[0])

    def mesh(self, frame: int) -> Mesh:
        first, second = (performance.mesh(frame) for performance in self.performances)
        parts = (first.vertices, second.vertices), (first.faces, second.faces + len(first.vertices)), (first.colours, second.colours)
        return Mesh(*map(np.concatenate, parts))


@dataclass(frozen=True)
class Pair:
    """A person who does not come alone, with the interface of a person."""

    person: Person
    other: Person
    other_landmarks: dict

    @property
    def build(self):
        return self.person.build

    def perform(self, landmarks, fps):
        return Together((self.person.perform(landmarks, fps), self.other.perform(self.other_landmarks, fps)))


def walker(rig, frames, seed):
    """A simulated person, and where the landmarks of his walk are."""
    cycle = load_cycle()
    landmarks = walk(cycle, frames / rig.fps, rig.fps, seed=seed, height_m=cycle.height_m)
    landmarks = {name: track[:frames] for name, track in landmarks.items()}
    stature = stature_m(landmarks)
    person = build_person(seed, stature)
    return person, centred(scaled(landmarks, person.build.height_m / stature), rig.aim_m)


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


def sessions(folder, frames, seed):
    """The session of each way."""
    rig = read_rig(definitions_folder() / "rigs" / "room_4.toml")
    person, landmarks = walker(rig, frames, seed)
    other, other_landmarks = walker(rig, frames, seed + 100)
    shift = BESIDE_M + (landmarks["pelvis"] - other_landmarks["pelvis"]).mean(axis=0) * [1, 1, 0]
    other_landmarks = {name: track + shift for name, track in other_landmarks.items()}
    options = Options(seed=seed)
    folders = [folder / f"{seed}_{name}" for name in ("alone", "crowd")]
    filmed = []
    for subject, place in zip((person, Pair(person, other, other_landmarks)), folders, strict=True):
        if not (place / "session.toml").exists():
            simulate(landmarks, rig, subject, options, place)
        filmed.append(load_session(place))
    alone, crowd = filmed
    return alone, crowd, with_others(crowd, rig, landmarks, other_landmarks, seed)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="folder to film into")
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--model", default="silhouettes")
    parser.add_argument("--json", type=Path, help="write the figures there, too")
    options = parser.parse_args()
    rows = []
    for seed in options.seeds:
        errors = []
        for way, session in zip(WAYS, sessions(options.folder, options.frames, seed), strict=True):
            model = bb.load_model(options.model, session, show=lambda _: None)
            draws = track(jax.random.key(seed), session, model, model.kernel(), frames=options.frames)
            errors.append(1000 * float(draws_against_truth(session, draws).plain.frame_error.mean()))
            print(f"seed {seed}, {way}: {errors[-1]:.1f} mm, {errors[-1] / errors[0]:.2f} of alone", flush=True)
        rows.append({"seed": seed, **dict(zip(WAYS, errors, strict=True))})
    if options.json:
        options.json.write_text(json.dumps(rows, indent=2))


if __name__ == "__main__":
    main()
