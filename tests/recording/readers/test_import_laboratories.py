"""Projects of Pose2Sim, OpenCV, EasyMocap, Anipose and Qualisys as sessions, and what is wrong with them in sentences."""

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
from body_figures import figures

from bayes_body.base.errors import InputError
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.readers.calibration.opencv import read_opencv
from bayes_body.recording.readers.calibration.qualisys import read_qualisys
from bayes_body.recording.readers.calibration.rewritten import rewrite_calibration
from bayes_body.recording.readers.calibration.toml import read_calibration_toml
from bayes_body.recording.readers.check import check_session
from bayes_body.recording.readers.opencv import import_opencv
from bayes_body.recording.readers.options import Options
from bayes_body.recording.readers.pose2sim import import_pose2sim
from bayes_body.recording.readers.qualisys import import_qualisys
from bayes_body.recording.readers.videos.video import read_video_frame
from bayes_body.recording.session.read import load_session, save_session

SIZE = (96, 64)
K = np.array([[90.0, 0, 48], [0, 92, 32], [0, 0, 1]])
NAMES = ("left", "right")
MM_Z = Options(unit="mm", up="z")


def pose(i: int) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and translation (metres) of two cameras that look at the z axis from 4 m, at right angles."""
    C = np.array([[4.0, 0.0, 1.0], [0.0, 4.0, 1.2]][i])
    forward = np.array([0, 0, 1.0]) - C
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    return R, -R @ C


def video(path, frames=6, fps=30.0, size=SIZE):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), fps, size)
    for k in range(frames):
        writer.write(np.full((*size[::-1], 3), 30 * k, np.uint8))
    writer.release()


def images(folder, first=0, count=6, size=SIZE):
    folder.mkdir(parents=True)
    for k in range(first, first + count):
        cv2.imwrite(str(folder / f"{k:04d}.png"), np.full(size[::-1], 200, np.uint8))


@pytest.fixture
def opencv(tmp_path):
    """A yml in millimetres and a video for each of two cameras."""
    source = tmp_path / "lab"
    source.mkdir()
    for i, name in enumerate(NAMES):
        R, t = pose(i)
        file = cv2.FileStorage(str(source / f"{name}.yml"), cv2.FILE_STORAGE_WRITE)
        for key, value in (("K", K), ("dist", np.zeros(5)), ("R", R), ("T", 1000 * t)):
            file.write(key, value)
        file.release()
        video(source / f"{name}.mp4")
    return source


@pytest.fixture
def pose2sim(tmp_path):
    """The same as a Pose2Sim project."""
    source = tmp_path / "project"
    (source / "calibration").mkdir(parents=True)
    (source / "videos").mkdir()
    tables = []
    for i, name in enumerate(NAMES):
        R, t = pose(i)
        vector = cv2.Rodrigues(R)[0].ravel().tolist()
        numbers = f"matrix = {K.tolist()}\ndistortions = [0.0, 0.0, 0.0, 0.0]\nrotation = {vector}\ntranslation = {t.tolist()}"
        tables.append(f'[{name}]\nname = "{name}"\nsize = {list(map(float, SIZE))}\n{numbers}\nfisheye = false\n')
        video(source / "videos" / f"{name}.mp4")
    (source / "calibration" / "Calib_board.toml").write_text("\n".join(tables) + "\n[metadata]\nadjusted = false\n")
    return source


@pytest.fixture
def qualisys(tmp_path):
    """The same from Qualisys, with a marker camera beside."""
    source = tmp_path / "qtm"
    source.mkdir()
    text = '<camera serial="77" model="Oqus 7"/>'
    for i, name in enumerate(NAMES):
        R, t = pose(i)
        turn = np.diag([1, -1, -1]) @ R
        turned = " ".join(f'r{a + 1}{b + 1}="{float(turn[a, b])!r}"' for a in range(3) for b in range(3))
        placed = " ".join(f'{axis}="{1000 * value:.9f}"' for axis, value in zip("xyz", -R.T @ t, strict=True))
        text += (
            f'<camera serial="{name}" model="Miqus Video"><fov_video left="0" top="0" right="{SIZE[0] - 1}" bottom="{SIZE[1] - 1}"/>'
            f'<transform {turned} {placed}/><intrinsic focalLengthU="{64 * K[0, 0]}" focalLengthV="{64 * K[1, 1]}" '
            f'centerPointU="{64 * K[0, 2]}" centerPointV="{64 * K[1, 2]}"/></camera>'
        )
        video(source / f"walk_Miqus_{i}_{name}.mp4")
    (source / "walk.qca.txt").write_text(f"<calibration><cameras>{text}</cameras></calibration>")
    return source


def keypoints(points_m: np.ndarray, i: int, confidence=0.8) -> list[float]:
    R, t = pose(i)
    pixels = cv2.projectPoints(points_m, cv2.Rodrigues(R)[0], t, K, None)[0][:, 0]
    return np.column_stack([pixels, np.full(len(pixels), confidence)]).ravel().tolist()


def write_poses(source, frames=6, people=1):
    """COCO_17 keypoints of one or two people, the second far smaller in all."""
    walk = figures("COCO_17", 30)[:frames] @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    for i, name in enumerate(NAMES):
        folder = source / "pose" / f"{name}_json"
        folder.mkdir(parents=True)
        for frame in range(frames):
            found = [keypoints(walk[frame], i)] + [keypoints(walk[frame] * 0.3, i)] * (people - 1)
            (folder / f"{name}.{frame:04d}.json").write_text(json.dumps({"people": [{"pose_keypoints_2d": each} for each in found]}))
    return walk


IMPORTS = {"opencv": (import_opencv, MM_Z), "pose2sim": (import_pose2sim, Options(up="z")), "qualisys": (import_qualisys, Options())}


@pytest.mark.parametrize("kind", IMPORTS)
def test_the_same_session_from_every_laboratory(kind, request, tmp_path):
    importer, options = IMPORTS[kind]
    source = request.getfixturevalue(kind)
    session, remarks = importer(source, tmp_path / "session", options)
    assert (session.up, session.fps, session.frames, session.first_frame) == ("z", 30.0, 6, 0)
    assert [view.camera.name for view in session.views] == list(NAMES)
    for i, view in enumerate(session.views):
        R, t = pose(i)
        np.testing.assert_allclose(view.camera.rotation, R, atol=1e-9)
        np.testing.assert_allclose(view.camera.translation_m, t, atol=1e-8)
        assert (view.camera.size_px, view.images, view.masks, view.offset) == (SIZE, None, None, 0)
        path = session.video_path(view)
        assert path is not None and path.is_file() and path.is_absolute()
    assert any("There are no masks: silhouettes are computed from a background learned" in remark for remark in remarks)
    assert load_session(save_session(session)) == session


IMPORTERS = {
    "opencv": (import_opencv, {"unit": "mm", "up": "z"}),
    "pose2sim": (import_pose2sim, {"up": "z"}),
    "qualisys": (import_qualisys, {}),
}


@pytest.mark.parametrize("source", IMPORTERS)
def test_a_range_of_frames(request, source, tmp_path):
    importer, given = IMPORTERS[source]
    folder = request.getfixturevalue(source)
    session, _ = importer(folder, tmp_path / "s", Options(**given, first_frame=2, frames=3))
    assert (session.first_frame, session.frames, session.recorded) == (2, 3, (0, 6))
    shown = [read_video_frame(session.video_path(view), session.number(view, 1), SIZE).mean() for view in session.views]
    assert shown == pytest.approx([90, 90], abs=4)
    with pytest.raises(InputError, match="--first-frame: 6; expected a frame of the recording, 0 to 5"):
        importer(folder, tmp_path / "s", Options(**given, first_frame=6))
    with pytest.raises(InputError, match="--frames: 5; expected a whole number from 1 to 4"):
        importer(folder, tmp_path / "s", Options(**given, first_frame=2, frames=5))


def test_units(opencv, tmp_path):
    with pytest.raises(InputError, match="--unit: not given; these files do not say the unit of their translations; expected m, cm, mm or in"):
        import_opencv(opencv, tmp_path / "s", Options(up="z"))
    with pytest.raises(InputError, match="--up: not given; these files do not say which axis of their world points up; expected x, y or z"):
        import_opencv(opencv, tmp_path / "s", Options(unit="mm"))
    with pytest.raises(InputError, match=r"cameras 5\d\d\d m apart .*factor of 1000"):
        import_opencv(opencv, tmp_path / "s", Options(unit="m", up="z"))
    assert not (tmp_path / "s").exists()


def test_pose2sims_toml_is_in_metres_and_its_up_axis_is_asked_for(pose2sim, tmp_path):
    _, remarks = import_pose2sim(pose2sim, tmp_path / "a", Options(up="y"))
    assert remarks[0] == "The calibration is assumed to be in metres, as Pose2Sim writes it; give --unit if it is not."
    with pytest.raises(InputError, match="--up: not given; Pose2Sim's toml does not say which axis of its world points up"):
        import_pose2sim(pose2sim, tmp_path / "b")
    with pytest.raises(InputError, match=r"all cameras within 0.0057 m"):
        import_pose2sim(pose2sim, tmp_path / "b", Options(up="y", unit="mm"))


def test_a_project_of_pose2sim_with_qualisyss_calibration(pose2sim, qualisys, tmp_path):
    (pose2sim / "calibration" / "Calib_board.toml").unlink()
    shutil.copy(qualisys / "walk.qca.txt", pose2sim / "calibration")
    session, _ = import_pose2sim(pose2sim, tmp_path / "a")
    assert session.up == "z"
    with pytest.raises(InputError, match="--unit: cm; expected mm, the unit of Qualisys's calibrations"):
        import_pose2sim(pose2sim, tmp_path / "b", Options(unit="cm"))


def test_aniposes_toml(pose2sim, tmp_path):
    session, _ = import_opencv(pose2sim, tmp_path / "a", Options(unit="m", up="z"))
    np.testing.assert_allclose(session.views[1].camera.translation_m, pose(1)[1], atol=1e-8)


def test_image_folders_counted_from_one_beside_a_video(opencv, tmp_path):
    (opencv / "left.mp4").unlink()
    images(opencv / "left", first=1, count=8)
    session, remarks = import_opencv(opencv, tmp_path / "a", MM_Z)
    left, right = session.views
    assert (session.frames, session.first_frame, left.offset, right.offset) == (6, 0, 1, 0)
    assert session.image_path(left, 0) == opencv.resolve() / "left" / "0001.png"
    assert any("(left 8, right 6): the session has the 6" in remark for remark in remarks)


def test_offsets(opencv, tmp_path):
    session, remarks = import_opencv(opencv, tmp_path / "a", Options("mm", "z", offsets={"left": -2}))
    assert (session.frames, session.first_frame) == (4, 0)
    assert [session.number(view, 0) for view in session.views] == [0, 2]
    assert any("starts 2 frames into the recording" in remark for remark in remarks)


def test_everything_beside_the_source(opencv, tmp_path):
    folder = tmp_path / "session"
    for name in NAMES:
        images(folder / "masks" / name)
        (tmp_path / "empty").mkdir(exist_ok=True)
        video(tmp_path / "empty" / f"{name}.mp4", 2)
    np.savez(tmp_path / "truth.npz", markers=np.zeros((6, 15, 3)), names=np.array(MARKERS))
    options = Options("mm", "z", 25.0, 1.8, folder / "masks", tmp_path / "empty", tmp_path / "truth.npz")
    session, remarks = import_opencv(opencv, folder, options)
    assert (session.fps, session.subject.height_m) == (25.0, 1.8)
    # Inside of the session's folder paths are relative: it can be moved.
    assert session.views[0].masks == "masks/left/%04d.png"
    assert session.views[1].background == str((tmp_path / "empty" / "right.mp4").resolve())
    assert session.truth_path == (tmp_path / "truth.npz").resolve()
    assert not any("no masks" in remark for remark in remarks)
    assert any("--fps 25 overrides the videos' rates (left 30, right 30)" in remark for remark in remarks)
    # The session keeps the videos' own rate, so that another video is noticed.
    assert [view.video_fps for view in load_session(save_session(session)).views] == [30.0, 30.0]
    check_session(session)


WRONG = {
    "masks of one camera": (lambda o, t: images(t / "m" / "left"), {"masks": "m"}, "m/right: no numbered images in it"),
    "masks from another number": (
        lambda o, t: [images(t / "m" / name, first=1) for name in NAMES],
        {"masks": "m"},
        "m/left: numbers 1 to 6; expected 0 to 5, this camera's frames",
    ),
    "small masks": (lambda o, t: [images(t / "m" / name, size=(9, 8)) for name in NAMES], {"masks": "m"}, "9 x 8 pixels; expected 96 x 64"),
    "no empty scene": (lambda o, t: None, {"background": "m"}, "no image or video for camera 'left'"),
    "no truth": (lambda o, t: None, {"truth": "t.npz"}, "t.npz: no such file"),
    "no video": (lambda o, t: (o / "left.mp4").unlink(), {}, "camera 'left': no video or folder of images with its name"),
    "another size": (lambda o, t: resize(o), {}, "camera 'left': left.mp4 has 96 x 64 pixels; expected 128 x 64"),
    "another rate": (lambda o, t: video(o / "left.mp4", fps=25.0), {}, "frame rate: cameras differ: left 25, right 30"),
    "no calibration": (lambda o, t: [(o / f"{name}.yml").unlink() for name in NAMES], {}, "no calibration in it"),
    "calibration cut short": (lambda o, t: (o / "left.yml").write_text("%YAML:1.0\n---\nK: ["), {}, "left.yml: cannot be read by OpenCV"),
}


def resize(source):
    path = source / "left.yml"
    path.write_text(path.read_text().replace("---\n", "---\nimage_width: 128\nimage_height: 64\n"))


@pytest.mark.parametrize("fault", WRONG)
def test_what_is_wrong_is_said(fault, opencv, tmp_path):
    damage, options, sentence = WRONG[fault]
    damage(opencv, tmp_path)
    paths = {key: tmp_path / name for key, name in options.items()}
    with pytest.raises(InputError, match=sentence) as error:
        import_opencv(opencv, tmp_path / "session", Options("mm", "z", **paths))
    assert all("expected" in line or "did you mean" in line or "known:" in line for line in str(error.value).splitlines())
    assert not (tmp_path / "session").exists()


@pytest.mark.parametrize("kind", IMPORTS)
def test_no_project(kind, tmp_path):
    importer, options = IMPORTS[kind]
    with pytest.raises(InputError, match="nowhere: no such folder"):
        importer(tmp_path / "nowhere", tmp_path / "session", options)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"empty: no .* in it"):
        importer(tmp_path / "empty", tmp_path / "session", options)


def test_two_calibrations(pose2sim, tmp_path):
    shutil.copy(pose2sim / "calibration" / "Calib_board.toml", pose2sim / "calibration" / "Calib_scene.toml")
    with pytest.raises(InputError, match=r"2 calibrations \(Calib_board.toml, Calib_scene.toml\)"):
        import_pose2sim(pose2sim, tmp_path / "s", Options(up="z"))


def test_first_keypoints_are_those_of_the_first_frame(pose2sim, tmp_path):
    write_poses(pose2sim, people=2)
    session, remarks = import_pose2sim(pose2sim, tmp_path / "a", Options(up="z", offsets={"right": 2}))
    assert set(session.initial_keypoints) == set(NAMES)
    assert set(session.initial_keypoints["left"]) >= {"nose", "l_shoulder", "r_ankle"}
    number = {name: session.number(view, 0) for name, view in zip(NAMES, session.views, strict=True)}
    assert number == {"left": 0, "right": 2}
    for name in NAMES:
        rows = json.loads((pose2sim / "pose" / f"{name}_json" / f"{name}.{number[name]:04d}.json").read_text())["people"]
        people = [tuple(row["pose_keypoints_2d"][:3]) for row in rows]
        assert session.initial_keypoints[name]["nose"] in people
    assert any("There are several people in the first frame. The subject is the one on whom most cameras agree" in remark for remark in remarks)
    assert not session.fit_lengths


def test_keypoints_that_cannot_be_used(pose2sim, tmp_path):
    with pytest.raises(InputError, match="--layout: COCO_17, but there are no keypoints in"):
        import_pose2sim(pose2sim, tmp_path / "a", Options(up="z", layout="COCO_17"))
    write_poses(pose2sim)
    for path in (pose2sim / "pose" / "left_json").iterdir():
        path.rename(path.with_name(path.name.replace("left.0", "left.4")))
    with pytest.raises(InputError, match="left_json: keypoints of 6 frames, numbered 4000 to 4005; expected numbers 0 to 5"):
        import_pose2sim(pose2sim, tmp_path / "a", Options(up="z"))


def test_nobody_in_the_first_frame(pose2sim, tmp_path):
    write_poses(pose2sim)
    for name in NAMES:
        for path in (pose2sim / "pose" / f"{name}_json").iterdir():
            path.write_text('{"people": []}')
    session, remarks = import_pose2sim(pose2sim, tmp_path / "a", Options(up="z"))
    assert session.initial_keypoints == {}
    assert any("contain no people" in remark for remark in remarks)


def test_calibrations_in_their_own_folder_and_percent_signs(opencv, tmp_path):
    source = tmp_path / "50% of %d"
    shutil.move(opencv, source)
    (source / "calibration").mkdir()
    for name in NAMES:
        (source / f"{name}.yml").rename(source / "calibration" / f"{name}.yml")
        (source / f"{name}.mp4").unlink()
        images(source / "images" / name)
    session, _ = import_opencv(source, tmp_path / "s", Options("mm", "z", fps=30.0))
    assert all(session.image_path(view, 5).exists() for view in session.views)
    assert len(read_opencv(source / "calibration", 1e-3)) == 2


@pytest.mark.slow
def test_real_project(pose2sim_beam, tmp_path):
    session, remarks = import_pose2sim(pose2sim_beam, tmp_path / "beam")
    assert (session.up, session.fps, session.frames) == ("z", 60.0, 100)
    assert [view.camera.size_px for view in session.views] == [(1080, 1920)] * 2 + [(1088, 1920)] * 2
    told = "\n".join(remarks)
    assert "calibrated at 1088 x 1920, the recording has 1080 x 1920" in told
    assert "read as BODY_25B" in told
    assert "cam01: #1 of 2, cam02: #1 of 2" in told
    assert all({"head", "l_hip", "r_ankle"} <= set(session.initial_keypoints[view.camera.name]) for view in session.views)


@pytest.mark.parametrize("kind", IMPORTS)
def test_new_cameras_are_written_as_they_were_imported(kind, request, tmp_path):
    importer, options = IMPORTS[kind]
    session, _ = importer(request.getfixturevalue(kind), tmp_path / "session", options)
    before = [view.camera for view in session.views]
    turn = cv2.Rodrigues(np.array([0.02, -0.01, 0.015]))[0]
    new = [replace(camera, rotation=turn @ camera.rotation, translation_m=turn @ camera.translation_m + 0.03) for camera in before]
    new[1] = replace(new[1], focal_px=(91.5, 93.25), centre_px=(47.0, 33.5))
    path = rewrite_calibration(session.calibration_path, tmp_path / "new", before, new)
    readers = {"opencv": lambda: read_opencv(path, 1e-3), "pose2sim": lambda: read_calibration_toml(path), "qualisys": lambda: read_qualisys(path)}
    assert path.name == session.calibration_path.name
    for read, camera in zip(readers[kind](), new, strict=True):
        assert read.name == camera.name
        np.testing.assert_allclose(read.rotation, camera.rotation, atol=1e-9)
        np.testing.assert_allclose(read.translation_m, camera.translation_m, atol=1e-9)
        np.testing.assert_allclose([*read.focal_px, *read.centre_px, *read.distortion], [*camera.focal_px, *camera.centre_px, *camera.distortion])
    # What belongs to no camera of the session stays.
    if kind != "opencv":
        assert {"pose2sim": "adjusted = false", "qualisys": "Oqus 7"}[kind] in path.read_text(encoding="utf-8")
