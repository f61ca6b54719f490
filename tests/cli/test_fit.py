"""`bayes-body fit`: cameras that were moved on purpose move back, and sessions that it cannot serve are refused."""

import dataclasses
import json
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from keypoint_walks import Network, person_of, seen_by, walk_session
from scipy.spatial.transform import Rotation

from bayes_body.base.geometry.camera import project
from bayes_body.model.build import build_model
from bayes_body.model.definition import load_definition, parse_definition
from bayes_body.model.unknowns.lengths import log_sd_of
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.readers.calibration.qualisys import read_qualisys
from bayes_body.recording.readers.keypoints.series import KeypointSeries, write_series
from bayes_body.recording.readers.options import Options
from bayes_body.recording.readers.pose2sim import import_pose2sim
from bayes_body.recording.readers.rig import read_rig
from bayes_body.recording.session.read import load_session, save_session
from bayes_body.recording.session.session import Session, Subject, View
from bayes_body.runs.unknowns.definition import with_unknowns
from bayes_body.runs.unknowns.fitted_session import moved_spec
from bayes_body.workshop.learning.walking_cycle import load_cycle
from bayes_body.workshop.learning.walking_cycle import walk as walking
from bayes_body.workshop.simulation.staging import centred, stacked

RIG = Path(__file__).parents[2] / "models" / "rigs" / "room_4.toml"
FRAMES, NOISE_PX, HEIGHT_M, TALLER_M = 20, 2.0, 1.75, 1.80
TURN_RAD, MOVE_M = np.radians(0.5), 0.02


def walk(model):
    """Poses of somebody who walks on through the room, swinging arms and legs, and turns."""
    phase = np.linspace(0, 1.5 * np.pi, FRAMES)
    poses = np.zeros((FRAMES, len(model.body.dof_names)))
    swing = {"l_hip_y": 25, "r_hip_y": -25, "l_shoulder_y": -20, "r_shoulder_y": 20, "thorax_z": 4}
    level = {"l_knee": -30, "r_knee": -30, "l_elbow": -50, "r_elbow": -35, "l_shoulder_x": -12, "r_shoulder_x": 12}
    for name, degrees in level.items():
        poses[:, model.body.dof_names.index(name)] = np.radians(degrees)
    for name, degrees in swing.items():
        poses[:, model.body.dof_names.index(name)] = np.radians(degrees) * np.sin(phase)
    for name, values in {"root_x": np.linspace(-0.6, 0.6, FRAMES), "root_z": 0.95, "root_yaw": np.linspace(0, 0.6, FRAMES)}.items():
        poses[:, model.body.dof_names.index(name)] = values
    return poses


@pytest.fixture
def recording(tmp_path):
    """A session with wrong cameras, and the motion that each would have to make; the person is taller than it says."""
    rng = np.random.default_rng(11)
    views = []
    for camera in read_rig(RIG).cameras:
        (tmp_path / camera.name).mkdir()
        for frame in range(FRAMES):
            (tmp_path / camera.name / f"{frame}.png").touch()
        views.append(View(camera, f"{camera.name}/%d.png", keypoints=f"{camera.name}.npz"))
    session = Session(tmp_path, "a walk", "z", 20.0, FRAMES, 0, tuple(views), Subject(height_m=TALLER_M))
    model = build_model("keypoints", session)
    places = jax.vmap(model.markers)(jnp.asarray(walk(model), jnp.float32))
    names = model.body.markers.names
    wrong, motions = [], []
    for index, view in enumerate(views):
        pixels, _ = project(jax.tree.map(lambda leaf, index=index: leaf[index], model.rig), places)
        points = np.dstack([np.asarray(pixels) + NOISE_PX * rng.normal(size=pixels.shape), np.full(pixels.shape[:2], 0.9)])
        write_series(tmp_path / f"{view.camera.name}.npz", KeypointSeries(points, names, 0))
        motion = np.concatenate([TURN_RAD * np.sign(rng.normal(size=3)), MOVE_M * np.sign(rng.normal(size=3))]) / np.sqrt(3)
        camera = moved_spec(view.camera, inverse(motion))
        np.testing.assert_allclose(moved_spec(camera, motion).translation_m, view.camera.translation_m, atol=1e-12)
        wrong.append(dataclasses.replace(view, camera=camera))
        motions.append(motion)
    session = dataclasses.replace(session, views=tuple(wrong), subject=Subject(height_m=HEIGHT_M))
    save_session(session)
    return session, np.array(motions)


def inverse(motion):
    """The motion of a camera that is undone by this one: it moves before it turns."""
    from scipy.spatial.transform import Rotation

    return np.concatenate([-motion[:3], -Rotation.from_rotvec(-motion[:3]).apply(motion[3:])])


@pytest.mark.long
@pytest.mark.usefixtures("optimised")
def test_cameras_move_back(cli, recording, tmp_path):
    session, motions = recording
    done = cli("fit", session.folder, "--out", tmp_path / "new", "--frames", FRAMES)
    assert done.status == 0, done.err
    content = json.loads((tmp_path / "new" / "fit.json").read_text(encoding="utf-8"))
    entries = content["unknowns"]["cameras"]
    mean, sd, prior_sd = (np.array([entry[key] for entry in entries]).reshape(motions.shape) for key in ("mean", "sd", "prior_sd"))
    assert np.abs((mean - motions) / sd).max() < 3
    # Turns are well determined: at most the common one of rig and person is left.
    assert (sd[:, :3] < 0.75 * prior_sd[:, :3]).all()
    assert np.linalg.norm((mean - motions)[:, :3]) < 0.8 * np.linalg.norm(motions[:, :3])
    before, after = (np.array([distances[key] for distances in content["keypoints_px"].values()]) for key in ("before", "after"))
    # The median length of the noise is all that is left.
    assert before.sum() > 1.5 * after.sum() and (after < 1.1 * NOISE_PX * np.sqrt(2 * np.log(2))).all()
    new = load_session(tmp_path / "new")
    assert new.subject.lengths_m.keys() >= {"torso", "l_thigh", "r_calf"}
    # What was inferred is the prior of whoever tracks the new session.
    known = {term.name: term for term in build_model("keypoints", new).unknowns}
    np.testing.assert_allclose(known["cameras"].sd, sd.ravel(), rtol=1e-5)
    offsets, entries = known["keypoint_offsets"], content["unknowns"]["keypoint_offsets"]
    assert offsets.space.labels == tuple(entry["name"] for entry in entries)
    np.testing.assert_allclose(offsets.mean, [entry["mean"] for entry in entries], atol=1e-8)
    np.testing.assert_allclose(offsets.sd, [entry["sd"] for entry in entries], rtol=1e-4)
    lengths = {entry["name"]: entry for entry in content["unknowns"]["lengths"]}
    # Lengths that the definition takes as exact have the common deviation alone, which is less than theirs.
    is_unknown = [name.removeprefix("l_").removeprefix("r_") in known["lengths"].space.labels for name in new.subject.lengths_m]
    inferred_sd = np.array([lengths[name]["sd"] / lengths[name]["mean"] for name in new.subject.lengths_m])
    np.testing.assert_allclose(log_sd_of(known["lengths"])[is_unknown], inferred_sd[is_unknown], rtol=1e-4)
    for view, before, motion in zip(new.views, session.views, mean, strict=True):
        wanted = moved_spec(before.camera, motion)
        np.testing.assert_allclose(view.camera.rotation, wanted.rotation, atol=1e-9)
        np.testing.assert_allclose(view.camera.translation_m, wanted.translation_m, atol=1e-8)
        assert new.keypoints_path(view) == session.keypoints_path(before)
        assert new.image_path(view, 3) == session.image_path(before, 3)


# Quarters of a frame by which the third camera shows later poses than the others, and frames of the walk.
LATE, QUARTERS, WALK = 9, 4, 72


@pytest.fixture
def late_walk(tmp_path):
    """A walk that a network sees, in which one camera's clock is wrong."""
    cycle, fine_fps = load_cycle(), QUARTERS * 60.0
    fine = walking(cycle, (WALK + 4) / 60.0, fine_fps, seed=4, height_m=cycle.height_m)
    points = centred(fine, read_rig(RIG).aim_m)
    person = person_of({name: track[: WALK * QUARTERS : QUARTERS] for name, track in points.items()}, known=False)
    network = Network(seed=4)
    session, _ = walk_session(tmp_path / "walk", person, network)
    later = stacked(points)[LATE : LATE + WALK * QUARTERS : QUARTERS]
    cameras = [view.camera for view in session.views]
    write_series(session.folder / f"{cameras[2].name}.npz", KeypointSeries(seen_by(network, cameras, later)[2], MARKERS, 0))
    views = []
    for view in session.views:
        (session.folder / view.camera.name).mkdir()
        for frame in range(WALK):
            (session.folder / view.camera.name / f"{frame}.png").touch()
        views.append(dataclasses.replace(view, images=f"{view.camera.name}/%d.png"))
    session = dataclasses.replace(session, views=tuple(views), initial_keypoints={}, fit_lengths=False)
    save_session(session)
    return session


@pytest.mark.long
def test_a_late_camera_is_shifted_and_the_rest_is_inferred(cli, late_walk, tmp_path):
    done = cli("fit", late_walk.folder, "--out", tmp_path / "new", "--delays")
    assert done.status == 0, done.err
    new = load_session(tmp_path / "new")
    shift = new.views[2].offset
    # Two frames and a quarter late: two frames or three are shifted, and the session begins with the first frame that all cameras have.
    assert ([view.offset for view in new.views], shift in (-2, -3)) == ([0, 0, shift, 0], True)
    assert (new.first_frame, new.frames) == (-shift, WALK + shift)
    assert f"camera '{new.views[2].camera.name}' fits the others best {-shift} frames earlier" in done.out
    known = [view.uncertainty for view in new.views]
    assert (known[0].delay_s, known[0].delay_sd_s) == (0.0, None)
    for camera, wanted in zip(known[1:], (0.0, (LATE / QUARTERS + shift) / 60.0, 0.0), strict=True):
        assert abs(camera.delay_s - wanted) < max(2 * camera.delay_sd_s, 0.008)
        assert camera.delay_sd_s < 0.008
    content = json.loads((tmp_path / "new" / "fit.json").read_text(encoding="utf-8"))
    assert not [remark for remark in content["warnings"] if "lost" in remark]


@pytest.mark.long
def test_a_camera_that_was_moved_on_purpose(cli, pose2sim_beam, tmp_path):
    """A real recording: one camera is turned by a degree and moved by 5 cm, two standard deviations of what a calibration is expected to be off."""
    session, _ = import_pose2sim(pose2sim_beam, tmp_path / "still", Options(up="z", height_m=1.75))
    motion = np.concatenate([np.radians(1.0) * np.array([1, -1, 1]), 0.05 * np.array([1, 1, -1])]) / np.sqrt(3)
    views = [dataclasses.replace(view, keypoints=str(session.keypoints_path(view))) for view in session.views]
    views[1] = dataclasses.replace(views[1], camera=moved_spec(views[1].camera, motion))
    save_session(dataclasses.replace(session, folder=tmp_path / "moved", views=tuple(views)))
    fits = []
    for name in ("still", "moved"):
        done = cli("fit", tmp_path / name, "--out", tmp_path / f"{name}_fit")
        assert done.status == 0, done.err
        fits.append((load_session(tmp_path / f"{name}_fit"), json.loads((tmp_path / f"{name}_fit" / "fit.json").read_text(encoding="utf-8"))))
    (still, still_content), (moved, moved_content) = fits
    for before, after in zip(still.views, moved.views, strict=True):
        turn = after.camera.rotation @ before.camera.rotation.T
        off = [*Rotation.from_matrix(turn).as_rotvec(), *(after.camera.translation_m - turn @ before.camera.translation_m)]
        assert np.abs(np.divide(off, [*after.uncertainty.turn_sd, *after.uncertainty.move_sd_m])).max() < 2
    for name, distances in moved_content["keypoints_px"].items():
        assert distances["after"] == pytest.approx(still_content["keypoints_px"][name]["after"], abs=0.5)
    read = read_qualisys(tmp_path / "still_fit" / "calibration" / "Calib.qca.txt")
    for camera, view in zip(read, still.views, strict=True):
        np.testing.assert_allclose(camera.rotation, view.camera.rotation, atol=1e-9)
        np.testing.assert_allclose(camera.translation_m, view.camera.translation_m, atol=1e-8)
    picture = cv2.imread(str(tmp_path / "still_fit" / "fit.png"))
    assert min(picture.shape[:2]) > 1000


def test_a_definition_with_unknowns_keeps_its_own():
    shipped = load_definition("keypoints")
    assert with_unknowns(shipped) is shipped
    begin, end = shipped.text.index("[[unknown]]"), shipped.text.index("[kernel]")
    plain = parse_definition("plain", shipped.text[:begin] + shipped.text[end:], shipped.body_text)
    free = with_unknowns(plain, 0.01)
    assert [term.kind for term in free.unknowns] == ["lengths", "cameras", "keypoint_offsets", "delays"]
    # The first pose was fitted with what is in doubt: nothing of it holds but what the motion prior says of rest.
    assert set(free.first.sd_deg.values()) == {30.0, *(sd for name, sd in plain.dynamics.options.spread_deg.items() if "root" not in name)}
    chosen = parse_definition("mine", f'{plain.text}\n[[unknown]]\nkind = "cameras"\nturn_sd_deg = 2.0\n', plain.body_text)
    assert with_unknowns(chosen) is chosen
    late = with_unknowns(chosen, 0.01)
    assert [term.kind for term in late.unknowns] == ["cameras", "delays"]
    assert late.unknowns[1].options.sd_s == 0.01
    assert (late.unknowns[0].options.turn_sd_deg, late.first) == (2.0, chosen.first)


def changed(session, folder, keep=None, **changes):
    views = session.views if keep is None else session.views[:keep]
    views = tuple(dataclasses.replace(view, **changes) for view in views)
    return save_session(dataclasses.replace(session, folder=folder, views=views)).parent


def test_sessions_without_enough_are_refused(cli, recording, tmp_path):
    session, _ = recording
    cli("fit", changed(session, tmp_path / "a", keypoints=None)).refuses("no cameras with keypoints", "--keypoints")
    cli("fit", changed(session, tmp_path / "b", keep=1)).refuses("1 camera with keypoints", "a small person")
    cli("fit", changed(session, tmp_path / "c", path="moves.npz")).refuses("camera 'C1'", "it moves")
    (tmp_path / "d").mkdir()
    empty = KeypointSeries(np.full((FRAMES, len(MARKERS), 3), np.nan), MARKERS, 0)
    write_series(tmp_path / "d" / "none.npz", empty)
    cli("fit", changed(session, tmp_path / "d", keypoints="none.npz")).refuses("no frame in which two cameras see the same 4 joints")
    cli("fit", session.folder, "--model", "silhouettes").refuses("model 'silhouettes'", "a model that reads keypoints")
    cli("fit", session.folder, "--out", session.folder).refuses("already holds a session.toml", "--out")
    cli("fit", session.folder, "--frames", 4).refuses("--frames", "from 5 to 20")
    cli("fit", tmp_path / "nowhere").refuses("no such folder")
    assert not list(tmp_path.glob("*_fit"))
