"""A simulated recording on disk: it loads, its pictures are of the person that its truth says, and its background tells the person apart."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from workshop.simulation.walker import FPS, walker

from bayes_body.base.errors import FaultyFileError, InputError
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.observation.frames import read_frame
from bayes_body.recording.readers.check import check_session
from bayes_body.recording.readers.images import read_mask
from bayes_body.recording.readers.rig import read_rig
from bayes_body.recording.readers.truth import read_truth
from bayes_body.recording.readers.videos.video import probe, read_video_frame
from bayes_body.recording.session.read import load_session
from bayes_body.workshop.simulation.film import EMPTY_FRAMES
from bayes_body.workshop.simulation.options import Options
from bayes_body.workshop.simulation.person import build_person
from bayes_body.workshop.simulation.session import simulate
from bayes_body.workshop.simulation.staging import centred, cut, scaled, stacked, stature_m
from bayes_body.workshop.simulation.visibility import detected, frames_seen

RIGS = Path(__file__).parents[3] / "models" / "rigs"
FRAMES = 6


def rig(name="room_4", count=2, scale=0.5):
    """A rig of smaller pictures."""
    whole = read_rig(RIGS / f"{name}.toml")
    cameras = []
    for camera in whole.cameras:
        size = tuple(round(scale * side) for side in camera.size_px)
        focal, centre = (tuple(scale * value for value in pair) for pair in (camera.focal_px, camera.centre_px))
        cameras.append(replace(camera, size_px=size, focal_px=focal, centre_px=centre))
    whole = replace(whole, cameras=tuple(cameras))
    return whole.select([camera.name for camera in whole.cameras[:count]])


def motion(frames=FRAMES):
    return centred(walker(frames), np.array((0, 0, 0.9)))


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    """Two cameras, good light, true silhouettes beside them."""
    folder = tmp_path_factory.mktemp("filmed") / "session"
    watched = []
    session, remarks = simulate(
        motion(),
        rig(),
        build_person(2, 1.78),
        Options(true_masks=True),
        folder,
        title="a walk",
        watch=lambda frames: (watched.append(k) or k for k in frames),
    )
    assert remarks == []
    assert watched == list(range(FRAMES))
    return session


def true_mask(session, view, frame):
    return read_mask(session.folder / "true_masks" / view.camera.name / f"{frame:06d}.png", view.camera.size_px)


def project(camera, points):
    """By the pinhole and the lens's polynomial, written out."""
    X, Y, Z = (points @ camera.rotation.T + camera.translation_m).T
    x, y = X / Z, Y / Z
    r2 = x * x + y * y
    k1, k2, p1, p2, k3 = camera.distortion
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    xd, yd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([camera.focal_px[0] * xd + camera.centre_px[0], camera.focal_px[1] * yd + camera.centre_px[1]], axis=1)


def test_the_session_loads_and_its_files_are_there(filmed):
    session = load_session(filmed.folder)
    assert check_session(session) == []
    assert (session.title, session.up, session.fps, session.frames, session.subject.height_m) == ("a walk", "z", FPS, FRAMES, 1.78)
    assert session.fit_lengths
    assert session.fit_outline
    assert [view.camera for view in session.views] == [view.camera for view in filmed.views]
    for view in session.views:
        assert view.masks is None
        assert probe(session.background_path(view)).frames == EMPTY_FRAMES
        assert probe(session.video_path(view))[:2] == (view.camera.size_px, FPS)


def test_the_truth_is_the_motion(filmed):
    np.testing.assert_allclose(read_truth(filmed.truth_path, FRAMES), stacked(motion()))
    with np.load(filmed.truth_path) as arrays:
        assert list(arrays["landmark_names"]) == list(motion())
        assert arrays["landmarks"].shape == (FRAMES, 15, 3)


def test_true_markers_project_into_the_true_silhouette(filmed):
    markers = read_truth(filmed.truth_path, FRAMES)
    for view in filmed.views:
        for frame in range(FRAMES):
            mask = true_mask(filmed, view, frame)
            column, row = np.rint(project(view.camera, markers[frame])).astype(int).T
            away = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)[row, column]
            # The crown lies on the outline.
            assert away.max() <= 2
            assert (away == 0).sum() >= 13
            # Mirrored left to right, or upside down, some would be outside.
            assert not mask[mask.shape[0] - 1 - row, column].all()


def test_the_background_tells_the_person_apart(filmed):
    overlaps = []
    for frame in (0, FRAMES - 1):
        found = read_frame(filmed, frame).masks
        for view, mask in zip(filmed.views, found, strict=True):
            true = true_mask(filmed, view, frame)
            overlaps.append((mask & true).sum() / (mask | true).sum())
    assert np.median(overlaps) > 0.85
    assert min(overlaps) > 0.75


def test_the_empty_scene_is_the_recordings_without_the_person(filmed):
    for view in filmed.views:
        empty = np.mean([read_video_frame(filmed.background_path(view), k).astype(float) for k in range(0, EMPTY_FRAMES, 5)], axis=0)
        image, mask = read_video_frame(filmed.video_path(view), 0).astype(float), true_mask(filmed, view, 0)
        around = cv2.dilate(mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        off = np.abs(image - empty).mean(axis=2)
        assert np.median(off[~around]) < 4
        assert np.median(off[mask]) > 20


def test_the_shadow_lies_on_the_floor_beside_the_feet(filmed):
    darker = []
    for view in filmed.views:
        empty = np.mean([read_video_frame(filmed.background_path(view), k).astype(float) for k in range(0, EMPTY_FRAMES, 5)], axis=0)
        image, mask = read_video_frame(filmed.video_path(view), 0).astype(float), true_mask(filmed, view, 0)
        lost = (empty - image).mean(axis=2)
        lost[cv2.dilate(mask.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0] = 0
        feet = np.flatnonzero(mask.any(axis=1))[-1]
        darker.append((lost[feet - 30 :] > 15).sum() - (lost[: feet - 60] > 15).sum())
    assert max(darker) > 100


def test_keypoints_are_a_detectors(filmed):
    markers = dict(zip(MARKERS, stacked(motion())[0], strict=True))
    camera = filmed.views[0].camera
    true = project(camera, np.stack(list(markers.values())))
    found = [detected(np.random.default_rng(seed), camera, markers, 3.0) for seed in range(60)]
    errors = np.array([[np.subtract(each[name][:2], place) for name, place in zip(MARKERS, true, strict=True)] for each in found])
    # Of 1800 numbers the standard deviation is known to 1.7 %.
    assert errors.std() == pytest.approx(3.0, rel=0.07)
    confidence = np.array([[each[name][2] for name in MARKERS] for each in found])
    assert 0.3 <= confidence.min() < confidence.max() <= 1
    assert np.corrcoef(np.linalg.norm(errors, axis=-1).ravel(), confidence.ravel())[0, 1] < -0.3
    assert set(filmed.initial_keypoints) == {view.camera.name for view in filmed.views}
    assert detected(np.random.default_rng(0), camera, {name: place + np.array((0, 0, 9.0)) for name, place in markers.items()}, 3.0) == {}


@pytest.mark.slow
def test_a_recording_is_the_same_for_the_same_seed(tmp_path):
    sessions = [
        simulate(motion(3), rig(scale=0.25), build_person(2, 1.78), Options(seed=seed), tmp_path / str(number))[0]
        for number, seed in enumerate((1, 1, 2))
    ]
    first, again, other = ([read_video_frame(session.video_path(view), 2) for view in session.views] for session in sessions)
    assert all((a == b).all() for a, b in zip(first, again, strict=True))
    assert all(np.abs(a.astype(int) - b).mean() > 5 for a, b in zip(first, other, strict=True))
    assert (tmp_path / "0/session.toml").read_text() == (tmp_path / "1/session.toml").read_text() != (tmp_path / "2/session.toml").read_text()
    assert not (first[0] == first[1]).all()


@pytest.mark.parametrize(("quality", "low", "high"), [("good", 0.85, 0.99), ("poor", 0.15, 0.85)])
def test_a_segmenters_silhouettes_take_the_backgrounds_place(tmp_path, quality, low, high):
    session, _ = simulate(motion(2), rig(), build_person(2), Options(segmentation=quality, true_masks=True), tmp_path / "s")
    assert check_session(session) == []
    assert all(view.background is None for view in session.views)
    assert not (tmp_path / "s/background").exists()
    frame = read_frame(session, 1)
    overlaps = []
    for view, mask in zip(session.views, frame.masks, strict=True):
        true = true_mask(session, view, 1)
        overlaps.append((mask & true).sum() / (mask | true).sum())
    assert low < np.mean(overlaps) < high


@pytest.mark.slow
def test_a_moving_camera_brings_its_places_and_silhouettes(tmp_path):
    moving = rig("moving_1", 1)
    moving = replace(moving, fps=2.0)
    landmarks = {name: np.repeat(track[:1], 5, axis=0) for name, track in motion().items()}
    session, _ = simulate(landmarks, moving, build_person(2), Options(true_masks=True), tmp_path / "s")
    (view,) = session.views
    assert view.masks is not None and view.background is None
    with np.load(tmp_path / "s/cameras/moving.npz") as arrays:
        rotations, translations = arrays["rotation"], arrays["translation_m"]
    assert rotations.shape == (5, 3, 3) and translations.shape == (5, 3)
    np.testing.assert_allclose(rotations[0], view.camera.rotation, atol=1e-12)
    places = -np.einsum("fba,fb->fa", rotations, translations)
    assert 2.5 < np.linalg.norm(places[4] - places[0]) < 3.2
    for frame in (0, 2, 4):
        camera = replace(view.camera, rotation=rotations[frame], translation_m=translations[frame])
        column, row = np.rint(project(camera, stacked(landmarks)[frame])).astype(int).T
        assert true_mask(session, view, frame)[row, column].sum() >= 13
    # The room moves through the picture.
    assert np.abs(read_video_frame(session.video_path(view), 0).astype(int) - read_video_frame(session.video_path(view), 4)).mean() > 10
    assert set(session.initial_keypoints) == {"moving"}


def test_a_users_own_background_is_filmed_before(tmp_path):
    rng = np.random.default_rng(0)
    (tmp_path / "empty").mkdir()
    pictures = {}
    for camera in rig().cameras:
        blobs = cv2.resize(rng.uniform(60, 200, (6, 8, 3)).astype(np.float32), camera.size_px, interpolation=cv2.INTER_CUBIC)
        pictures[camera.name] = np.clip(blobs, 0, 255).astype(np.uint8)
        cv2.imwrite(str(tmp_path / "empty" / f"{camera.name}.png"), pictures[camera.name])
    session, _ = simulate(motion(2), rig(), build_person(2), Options(background=tmp_path / "empty", noise=0.0), tmp_path / "s")
    for view in session.views:
        off = np.abs(read_video_frame(session.background_path(view), 0).astype(int) - pictures[view.camera.name])
        assert np.median(off) <= 2
    with pytest.raises(InputError, match=r"--background .*: camera 'moving' moves; expected cameras that do not move"):
        simulate(motion(2), rig("moving_1", 1), build_person(2), Options(background=tmp_path / "empty"), tmp_path / "t")
    (tmp_path / "empty/C2.png").unlink()
    with pytest.raises(InputError, match="no image or video for camera 'C2'"):
        simulate(motion(2), rig(), build_person(2), Options(background=tmp_path / "empty"), tmp_path / "t")


def test_cameras_that_do_not_see_the_person_are_named(tmp_path):
    away = {name: track + np.array((12.0, 3.0, 0.0)) for name, track in motion().items()}
    with pytest.raises(FaultyFileError) as error:
        simulate(away, rig(), build_person(2), Options(), tmp_path / "s")
    first, second = error.value.sentences
    assert first.startswith("rig room_4: camera 'C1': sees the person in 0 of 6 frames; expected a camera that sees the person, who is around (12.")
    assert "look" not in first and "--cameras" in first and "'C2'" in second
    assert not (tmp_path / "s").exists()


def test_a_person_who_leaves_the_picture_is_told(tmp_path):
    landmarks = centred({name: track * (4.0, 1, 1) for name, track in walker(120).items()}, np.array((0, 0, 0.9)))
    side = rig("side_1", 1)
    seen = frames_seen(side.posed(120)[0], stacked(landmarks))
    assert 40 < seen.sum() < 110
    landmarks = cut(landmarks, 50, None)
    count = int(frames_seen(side.posed(70)[0], stacked(landmarks)).sum())
    _, remarks = simulate({name: track[::10] for name, track in landmarks.items()}, side, build_person(2), Options(), tmp_path / "s")
    assert 0 < count < 70
    assert len(remarks) == 1
    assert "camera 'side' sees the person in" in remarks[0] and "of 7 frames" in remarks[0]


def test_what_cannot_be_written_or_is_there_already_is_said(tmp_path, filmed):
    with pytest.raises(InputError, match=r"already holds a session.toml; expected a folder without one"):
        simulate(motion(2), rig(), build_person(2), Options(), filmed.folder)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be made"):
        simulate(motion(2), rig(), build_person(2), Options(), tmp_path / "file" / "s")
    missing = {name: track for name, track in motion(2).items() if name != "l_knee"}
    with pytest.raises(InputError, match="no l_knee"):
        simulate(missing, rig(), build_person(2), Options(), tmp_path / "s")


@pytest.mark.parametrize(
    ("options", "said"),
    [({"noise": -1.0}, "--noise: -1; expected 0 to 5"), ({"clutter": float("nan")}, "--clutter: nan; expected 0 to 5"), ({"seed": -1}, "--seed: -1")],
)
def test_options_that_cannot_be_are_refused(options, said):
    with pytest.raises(InputError, match=said):
        Options(**options)


def test_a_motion_is_put_on_the_stage():
    landmarks = walker(60)
    # 1.75 m from crown to ankle plus 0.08 m of foot, a bit less for a bent neck and knees: the figures of the walker.
    assert stature_m(landmarks) == pytest.approx(1.75, abs=0.06)
    assert stature_m(scaled(landmarks, 1.1)) == pytest.approx(1.1 * stature_m(landmarks))
    moved = centred(landmarks, np.array((1.0, 2.0, 0.9)))
    way = moved["pelvis"]
    np.testing.assert_allclose((way.min(axis=0) + way.max(axis=0))[:2] / 2, (1, 2))
    np.testing.assert_allclose(moved["head"][:, 2], landmarks["head"][:, 2])
    assert len(cut(landmarks, 50, None)["head"]) == 10
    for first, frames, said in (
        (60, None, "--first-frame: 60; expected 0 to 59"),
        (50, 11, "--frames: 11; expected 1 to 10"),
        (-1, 3, "--first-frame"),
    ):
        with pytest.raises(InputError, match=said):
            cut(landmarks, first, frames)
