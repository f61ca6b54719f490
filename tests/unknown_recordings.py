"""Recordings of people of whom the session says what is not exact: lengths, cameras, clocks and where keypoints lie.

A person moves by the joint angles with which the model's body follows landmarks best. Lengths, cameras, delays and offsets of keypoints are drawn
from other tables than those of the model's prior. The session has the table's lengths for a height, and the cameras before they were moved.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from keypoint_walks import RIG, seen_by
from scipy.interpolate import CubicSpline

from bayes_body.base.files.shipped import definitions_folder
from bayes_body.initial.retarget import retarget
from bayes_body.model.body.build import Shape, build_body
from bayes_body.model.body.placed_body import placed_markers
from bayes_body.model.definition import load_definition
from bayes_body.recording.evidence.markers import MARKERS, evidence_names
from bayes_body.recording.readers.keypoints.series import KeypointSeries, write_series
from bayes_body.recording.readers.rig import read_rig
from bayes_body.recording.session.session import Session, Subject, View
from bayes_body.runs.unknowns.fitted_session import moved_spec
from bayes_body.workshop.compare.scenes import _blank
from bayes_body.workshop.simulation.staging import stature_m

# Length of a bone over that of the table, in the mean of people; 1 for all others. The table's clavicles lead to the centres of the shoulders.
OTHER_TABLE = {"clavicle": 0.94, "pelvis": 1.1, "calf": 0.96, "thigh": 1.03}
# Frames before and behind the recording, for cameras whose clocks are early or late.
MARGIN = 3


class Spread(NamedTuple):
    """How far the truth is from what the session says; 0 is exact.

    Attributes:
        height: relative standard deviation of the stated height.
        bones: that of each bone.
        table: what the length of a bone is multiplied by, before that.
        turn_deg: standard deviation of a camera's turn about each axis.
        move_m: that of its move along each axis.
        offset_m: that of a keypoint's offset along each axis of its joint's frame.
        delay_s: range of the delays of all cameras but the first, of either sign.
        whole_frames: whether delays were rounded off to whole frames by shifting the cameras, so that less than half a frame is left.
    """

    height: float = 0.01
    bones: float = 0.04
    table: Mapping[str, float] = OTHER_TABLE
    turn_deg: float = 0.5
    move_m: float = 0.02
    offset_m: float = 0.01
    delay_s: tuple[float, float] = (0.0, 0.0)
    whole_frames: bool = False


class Truth(NamedTuple):
    """What the session does not say exactly: lengths (metres, by name), motions of the cameras (camera, 6), delays (camera,), offsets (marker, 3)."""

    lengths_m: dict[str, float]
    motions: np.ndarray
    delays_s: np.ndarray
    offsets_m: np.ndarray


class Recording(NamedTuple):
    """A session as a user has it, the same with true lengths and cameras, and the truth."""

    session: Session
    known: Session
    truth: Truth


class Movement(NamedTuple):
    """Joint angles (frame, dof) of the body of the model `keypoints`, with MARGIN frames before and behind, and the person's height, metres."""

    angles: np.ndarray
    height_m: float
    fps: float


def movement_of(points, fps):
    """The angles with which the model's body follows landmarks (by name, (frame, 3), metres)."""
    definition, height = load_definition("keypoints"), stature_m(points)
    body = build_body(definition.body_name, definition.body, Shape(height))
    fit = retarget(body, points, fps, schema=definition.body)
    angular = np.array(body.skeleton.topology.angular)
    return Movement(np.where(angular, np.unwrap(fit.angles, axis=0), fit.angles), height, fps)


def record(folder, movement, network, spread=Spread(), seed=0):
    """Film a movement. What is drawn depends on the seed only; keypoints depend on the network's seed."""
    definition, rng = load_definition("keypoints"), np.random.default_rng(seed)
    cameras = read_rig(definitions_folder() / "rigs" / f"{RIG}.toml").cameras
    lengths = _lengths(rng, definition.body, movement.height_m, spread)
    body = build_body(definition.body_name, definition.body, Shape(movement.height_m, lengths))
    motions = np.radians(spread.turn_deg) * rng.standard_normal((len(cameras), 3)), spread.move_m * rng.standard_normal((len(cameras), 3))
    offsets = spread.offset_m * rng.standard_normal((len(body.markers.names), 3))
    truth = Truth(lengths, np.concatenate(motions, axis=1), _delays(rng, len(cameras), movement.fps, spread), offsets)
    stated_m = round(movement.height_m * np.exp(spread.height * rng.standard_normal()), 3)

    true_cameras = [moved_spec(camera, motion) for camera, motion in zip(cameras, truth.motions, strict=True)]
    seen = seen_by(network, true_cameras, np.stack([_keypoints(body, movement, delay, offsets) for delay in truth.delays_s]))
    folder.mkdir(parents=True, exist_ok=True)
    names = evidence_names(body.markers.names)
    for camera, series in zip(cameras, seen, strict=True):
        write_series(folder / f"{camera.name}.npz", KeypointSeries(series, names, 0))
    angles = movement.angles[MARGIN:-MARGIN]
    markers = _placed(body, angles)[:, [body.markers.names.index(name) for name in MARKERS]]
    np.savez(folder / "truth.npz", markers=markers, names=np.array(MARKERS), angles=angles, dof_names=np.array(body.dof_names), body=body.name)

    def session_of(specs, subject):
        views = tuple(View(camera, images=_blank(folder, camera), keypoints=f"{camera.name}.npz") for camera in specs)
        return Session(folder, "a person", "z", movement.fps, len(angles), 0, views, subject, truth="truth.npz")

    stated = session_of(cameras, Subject(height_m=stated_m))
    return Recording(stated, session_of(true_cameras, Subject(definition.body_name, movement.height_m, lengths)), truth)


def _lengths(rng, schema, height_m, spread):
    bones = {name: name[2:] if name.startswith(("l_", "r_")) else name for name in schema.lengths_of_height}
    deviations = {bone: np.log(spread.table.get(bone, 1.0)) + spread.bones * rng.standard_normal() for bone in dict.fromkeys(bones.values())}
    return {name: float(share * height_m * np.exp(deviations[bones[name]])) for name, share in schema.lengths_of_height.items()}


def _delays(rng, cameras, fps, spread):
    sizes = rng.choice([-1.0, 1.0], cameras - 1) * rng.uniform(*spread.delay_s, cameras - 1)
    delays = np.concatenate([[0.0], sizes])
    return delays - np.rint(delays * fps) / fps if spread.whole_frames else delays


def _keypoints(body, movement, delay_s, offsets_m):
    """Where keypoints lie (frame, marker, 3) in the frames of a camera, in the order of the evidence; NaN for markers that are absent."""
    times = np.arange(len(movement.angles)) + delay_s * movement.fps
    angles = CubicSpline(np.arange(len(movement.angles)), movement.angles)(times)[MARGIN:-MARGIN]
    names, evidence = body.markers.names, evidence_names(body.markers.names)
    shifted = replace(body, markers=replace(body.markers, offsets=body.markers.offsets + jnp.asarray(offsets_m, body.markers.offsets.dtype)))
    points = np.full((len(angles), len(evidence), 3), np.nan)
    present = [name for name in evidence if name in names]
    points[:, [evidence.index(name) for name in present]] = _placed(shifted, angles)[:, [names.index(name) for name in present]]
    return points


def _placed(body, angles):
    return np.asarray(jax.vmap(placed_markers, (None, 0))(body, jnp.asarray(angles, body.lengths.dtype)), float)
