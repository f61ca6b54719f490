"""Walks without pictures: the true markers of a simulated person, and what a keypoint network might see of them in the four cameras of `room_4`."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from bayes_body.base.files.shipped import definitions_folder
from bayes_body.initial.retarget import retarget
from bayes_body.model.body.build import build_body
from bayes_body.model.definition import load_body
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.readers.keypoints.series import KeypointSeries, write_series
from bayes_body.recording.readers.mocap import landmarks, read_motion, resample
from bayes_body.recording.readers.rig import read_rig
from bayes_body.recording.session.session import Session, Subject, View
from bayes_body.workshop.compare.scenes import _blank
from bayes_body.workshop.learning.walking_cycle import load_cycle, walk
from bayes_body.workshop.simulation.staging import centred, cut, stacked, stature_m
from bayes_body.workshop.simulation.visibility import detected, pixels

RIG, BODY = "room_4", "deutscher_31"
# Of the first pose, as in `bayes-body simulate`.
FIRST_SD_PX = 3.0


class Person(NamedTuple):
    """The true markers (frame, 15, 3), metres, and the session's subject; `known` is whether the model's body is exactly that of the person."""

    markers: np.ndarray
    subject: Subject
    known: bool


def shipped_walk(frames, seed):
    """Landmarks of the walk of `bayes-body simulate walk --subject SEED`."""
    rig, cycle = _rig(), load_cycle()
    return centred(walk(cycle, frames / rig.fps, rig.fps, seed=seed, height_m=cycle.height_m), rig.aim_m)


def captured_walk(path, frames, first=0, fps=None):
    """Landmarks of a captured motion, as `bayes-body simulate FILE.amc --first-frame FIRST` films it. `fps` is the rig's by default."""
    rig = _rig()
    return centred(cut(landmarks(resample(read_motion(path), fps or rig.fps)), first, frames), rig.aim_m)


def person_of(points, known):
    """A person whose body is exactly the model's, in the nearest pose to the landmarks, or one whose body the model has to fit."""
    if not known:
        return Person(stacked(points), Subject(height_m=round(stature_m(points), 3)), False)
    schema = load_body(BODY)
    fit = retarget(build_body(BODY, schema), points, _rig().fps, schema=schema)
    markers = fit.markers_m[:, [fit.marker_names.index(name) for name in MARKERS]]
    return Person(markers, Subject(body=BODY, lengths_m={name: float(value) for name, value in fit.lengths_m.items()}), True)


class Network(NamedTuple):
    """What a keypoint network makes of true pixels.

    Attributes:
        outliers: fraction of the keypoints that are anywhere in the image, with a confidence like that of the others.
        missing: fraction that is not seen.
        noise: "simulated", the detector of `bayes-body simulate`: Gaussian, 3 pixels, with a smaller confidence where the error is larger; or
            "assumed", what the model `keypoints` assumes: Student's t, with a confidence of 1.
        seed: random seed.
        lasting: share of the squared scale of "assumed" noise that is a normal error of each keypoint and camera which fades slowly.
        fades_frames: after so many frames it has faded to 37 %.
        scale_px: scale of "assumed" noise, in an image with a diagonal of 800 pixels; that of the model `keypoints` by default.
    """

    outliers: float = 0.0
    missing: float = 0.0
    noise: str = "simulated"
    seed: int = 0
    lasting: float = 0.0
    fades_frames: float = 30.0
    scale_px: float = 5.0


def seen_by(network, cameras, markers):
    """Column, row, confidence (camera, frame, marker, 3) of true markers; NaN where not seen.

    `markers` are (frame, marker, 3), or (camera, frame, marker, 3) if each camera has a time of its own.
    """
    rng = np.random.default_rng(network.seed)
    by_camera = np.broadcast_to(markers, (len(cameras), *markers.shape[-3:]))
    seen = np.stack([[_seen(rng, network, camera, points) for points in path] for camera, path in zip(cameras, by_camera, strict=True)])
    size = np.array([camera.size_px for camera in cameras])[:, None, None]
    if network.lasting:
        seen[..., :2] += np.hypot(*np.moveaxis(size, -1, 0))[..., None] / 800 * _lasting_errors(network, seen[..., :2].shape)
    is_wrong = rng.random(seen.shape[:3]) < network.outliers
    seen[..., :2] = np.where(is_wrong[..., None] & np.isfinite(seen[..., :2]), rng.random(seen[..., :2].shape) * size, seen[..., :2])
    return np.where((rng.random(seen.shape[:3]) < network.missing)[..., None], np.nan, seen)


def _seen(rng, network, camera, points):
    if network.noise == "simulated":
        found = detected(rng, camera, dict(zip(MARKERS, points, strict=True)), FIRST_SD_PX)
        return np.array([found.get(name, (np.nan,) * 3) for name in MARKERS])
    true, visible = pixels(camera, points)
    scale_px = network.scale_px * np.sqrt(1 - network.lasting) * np.hypot(*camera.size_px) / 800
    off = scale_px * rng.standard_normal(true.shape) / np.sqrt(rng.chisquare(3, (len(true), 1)) / 3)
    return np.where(visible[:, None], np.column_stack([true + off, np.ones(len(true))]), np.nan)


def _lasting_errors(network, shape):
    """Errors (camera, frame, marker, 2) of a stationary autoregression, pixels of an image with a diagonal of 800."""
    rng, retention = np.random.default_rng((network.seed, 29)), np.exp(-1 / network.fades_frames)
    steps = network.scale_px * np.sqrt(network.lasting) * rng.standard_normal(shape)
    for frame in range(1, shape[1]):
        steps[:, frame] = retention * steps[:, frame - 1] + np.sqrt(1 - retention**2) * steps[:, frame]
    return steps


def walk_session(folder, person, network, cameras=None):
    """A session with the keypoints and the truth, and the keypoints themselves. `cameras` are the names of those that are there; all by default."""
    rig = _rig() if cameras is None else _rig().select(cameras)
    seen = seen_by(network, rig.cameras, person.markers)
    folder.mkdir(parents=True, exist_ok=True)
    views, first = [], {}
    for number, (camera, series) in enumerate(zip(rig.cameras, seen, strict=True)):
        write_series(folder / f"{camera.name}.npz", KeypointSeries(series, MARKERS, 0))
        views.append(View(camera, images=_blank(folder, camera), keypoints=f"{camera.name}.npz"))
        points = dict(zip(MARKERS, person.markers[0], strict=True))
        first[camera.name] = detected(np.random.default_rng((network.seed, 17, number)), camera, points, FIRST_SD_PX)
    np.savez(folder / "truth.npz", markers=person.markers, names=np.array(MARKERS))
    session = Session(
        folder,
        "a walk without pictures",
        "z",
        rig.fps,
        len(person.markers),
        0,
        tuple(views),
        person.subject,
        initial_keypoints=first,
        truth="truth.npz",
    )
    # With one camera a small person cannot be told from a distant one.
    return replace(session, fit_lengths=not person.known and len(views) > 1), seen


def _rig():
    return read_rig(definitions_folder() / "rigs" / f"{RIG}.toml")
