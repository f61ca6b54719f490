"""The 3D page of a run: what is in it, what is not, and that a browser without a network shows and plays it."""

import base64
import dataclasses
import re
import shutil
import socket

import cv2
import jax
import jax.numpy as jnp
import msgspec
import numpy as np
import pytest
import zstandard
from people_runs import person_run

from bayes_body.base.geometry import rotations
from bayes_body.cli.main import main
from bayes_body.model.body.solids import part_transforms
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.readers.keypoints.triangulate import project
from bayes_body.recording.session.session import CameraSpec
from bayes_body.results.storage.saved_run import load_run
from bayes_body.view.colours import person_colour
from bayes_body.view.viewer import page as pages
from bayes_body.view.viewer import write_view
from bayes_body.view.viewer.motion import LARGEST, Budget, read_poses
from bayes_body.view.viewer.recording import flat
from bayes_body.view.viewer.solids import part_mesh

ARM_DOFS = ("shoulder_x", "shoulder_y", "shoulder_z", "elbow")
RADIANS = ("rad",) * len(ARM_DOFS)
EVIL = "</script><img src=x onerror=window.harmed=1><script>window.harmed=1</script>"
TRACK = "document.querySelector('[class*=Slider-track]')"


@pytest.fixture(scope="module")
def make_arm(make_run, keypoint_session):
    """`make_arm(runs=2, frames=5, ...)`: the run of an arm that bends, with images, truth and keypoints of its recording."""

    def call(recording=keypoint_session, **arrays):
        time = np.linspace(0, 1, arrays.get("frames", 5))[:, None]
        pose = time * [0.8, 0.2, 0.0, 1.2] + 0.1 * np.random.default_rng(0).normal(size=(arrays.get("runs", 2), 60, len(time), 4))
        truth = np.random.default_rng(1).uniform(0.5, 1.5, (len(time), len(MARKERS), 3))
        return make_run(dofs=ARM_DOFS, units=RADIANS, recording=recording, **({"pose": pose, "truth": truth} | arrays))

    return call


def written(folder, **options):
    with load_run(folder) as run:
        return write_view(run, **options)


def record(page):
    """The messages of a page, as (seconds, message), with their arrays."""
    content = base64.b64decode(re.search(r'__VISER_EMBED_DATA__="([^"]*)"', page.read_text(encoding="utf-8"))[1])
    inner = zstandard.ZstdDecompressor().decompressobj().decompress(content[8:])
    return msgspec.msgpack.decode(inner[8 : 8 + int.from_bytes(inner[:8], "little")])


def names(page):
    return {message["name"] for _, message in record(page)["messages"] if message.get("name")}


@pytest.fixture(scope="module")
def page(make_arm, keypoint_session, tmp_path_factory):
    folder = shutil.copytree(keypoint_session.folder, tmp_path_factory.mktemp("unseen") / "session")
    # The first camera did not see the last frame.
    (folder / "a" / "image0004.png").unlink()
    views = [dataclasses.replace(view, camera=dataclasses.replace(view.camera, name=f"{EVIL}/{view.camera.name}")) for view in keypoint_session.views]
    return written(make_arm(recording=dataclasses.replace(keypoint_session, folder=folder, views=tuple(views)), title=EVIL))[0]


@pytest.mark.slow
def test_a_browser_without_a_network_shows_it_and_moves_to_a_later_frame(tab, page):
    shown = tab(page)
    left, top, width, height = shown.until(f"(() => {{ const r = {TRACK}?.getBoundingClientRect(); return r && [r.x, r.y, r.width, r.height] }})()")
    bar = "document.querySelector('[class*=Slider-bar]').offsetWidth"
    # It plays by itself, until the space bar stops it.
    shown.until(f"{bar} !== {shown.value(bar)}")
    shown.press("Space", " ")
    pictures = []
    for place in (0.1, 0.9):
        shown.click(left + place * width, top + height / 2)
        pictures.append(shown.still()[: int(top) - 20, 330:])
    # The arm is drawn, it has moved, and most of the picture is the same floor.
    moved = (pictures[0] != pictures[1]).any(axis=-1).mean()
    assert 0.001 < moved < 0.3 and all(np.unique(picture).size > 50 for picture in pictures)
    assert shown.faults() == [] and shown.value("window.harmed === undefined")
    assert EVIL in shown.value("document.getElementById('run').innerText")


def test_what_is_in_it(page):
    whole, found = record(page), names(page)
    assert whole["durationSeconds"] == pytest.approx(5 / 60)
    assert {"/Draws", "/True markers", "/Triangulated keypoints", "/Time", "/WorldAxes", "/Floor, tiles of 1 m"} <= found
    assert sum(name.startswith("/Mean body/") for name in found) == 3
    # A camera is one node, whatever its name.
    assert sorted(name.count("/") for name in found if name.startswith("/Cameras/")) == [2, 2]
    assert EVIL not in page.read_text(encoding="utf-8") and 800_000 < page.stat().st_size < 1_500_000
    # An image stays no longer than its frame: the first camera did not see the last one.
    cameras = [message for _, message in whole["messages"] if "_image_data" in message.get("props", message.get("updates", {}))]
    images = {camera: [each for each in cameras if each["name"].startswith(f"/Cameras/{camera} ")] for camera in (1, 2)}
    assert [len(images[camera]) for camera in (1, 2)] == [5, 5]
    assert [images[camera][-1]["updates"]["_image_data"] is None for camera in (1, 2)] == [True, False]


def test_nothing_listens_and_nothing_is_printed(make_arm, monkeypatch, capfd):
    def listen(*arguments):
        raise AssertionError("a port was opened")

    for name in ("bind", "listen"):
        monkeypatch.setattr(socket.socket, name, listen)
    written(make_arm(frames=2))
    assert capfd.readouterr() == ("", "")


def test_a_mode_seeker_has_no_draws_and_a_sentence_why(make_arm):
    path, remarks = written(make_arm(log_evidence=np.full((2, 5), np.nan), lost=np.arange(5) == [[2], [3]]))
    assert remarks[0] == "Frames 2-3: lost, or the body is off the person."
    assert "/Draws" not in names(path) and any("not a measure of uncertainty" in remark for remark in remarks)
    assert "not a measure of uncertainty" in path.read_text(encoding="utf-8")


def test_files_that_have_changed_are_not_shown(make_arm):
    folder = make_arm()
    with load_run(folder) as run:
        session = run.session
    (session.folder / "a" / "image0000.png").write_bytes((session.folder / "b" / "image0000.png").read_bytes())
    (session.folder / "b.npz").write_bytes((session.folder / "a.npz").read_bytes() + b"\0")
    np.savez(session.folder / "truth.npz", markers=np.zeros((5, len(MARKERS), 3)), names=np.array(MARKERS))
    path, remarks = written(folder)
    assert not names(path) & {"/True markers", "/Triangulated keypoints"}
    images = [message for _, message in record(path)["messages"] if message["type"] == "CameraFrustumMessage"]
    assert [message["props"]["_image_data"] is None for message in images] == [True, False]
    assert [re.match(r"The (\w+ \w+)", remark)[1] for remark in remarks] == ["images of", "keypoints of", "true markers"]


def test_the_mean_is_where_the_posterior_says_and_draws_have_equal_weight(make_arm):
    weights = np.full((2, 60, 5), -np.inf)
    weights[:, 7, 2] = 0.0
    weights[:, :, [0, 1, 3, 4]] = -np.log(60)
    with load_run(make_arm(log_weight=weights)) as run:
        poses = list(read_poses(run, range(5), 12))
        cloud = jnp.asarray(np.asarray(run.tree["posterior"]["pose"]))
        body = run.model.body
        expected = [part_transforms(body, pose) for pose in (cloud[0, 7, 2], cloud[1, 7, 2])]
    # All weight is on one draw of each run.
    ends = np.stack([np.stack([T.origin, T.origin + np.asarray(body.lengths)[:, None] * T.z], axis=1) for T in expected])
    assert np.abs(poses[2].draws - np.repeat(ends, 6, axis=0)).max() < 1e-5
    # Two draws have nothing between them: the body is one of them. Where there are many, it is their mean.
    (same,) = [T for T in expected if np.abs(poses[2].origins - np.asarray(T.origin)).max() < 1e-5]
    assert np.abs(np.asarray(rotations.to_matrix(poses[2].quaternions)) - np.asarray(same.rotation)).max() < 1e-5
    middle = part_transforms(body, cloud[:, :, 4].mean(axis=(0, 1)))
    assert [pose.is_mean for pose in poses] == [True, True, False, True, True]
    assert np.abs(poses[4].origins - np.asarray(middle.origin)).max() < 1e-5
    assert np.abs(np.asarray(rotations.to_matrix(poses[4].quaternions)) - np.asarray(middle.rotation)).max() < 1e-5
    # Draws that all have the same weight are the same ones in every frame: twelve of 120, evenly spaced.
    origins = np.asarray(jax.vmap(lambda pose: part_transforms(body, pose).origin)(cloud.reshape(120, 5, 4)[:, 4]))
    found = [int(np.abs(origins - draw[:, 0]).max(axis=(1, 2)).argmin()) for draw in poses[4].draws]
    assert np.unique(np.diff(found)).tolist() == [10]


def test_parts_are_closed_and_as_wide_as_the_body(make_arm):
    with load_run(make_arm(frames=1)) as run:
        body = run.model.body
    radii = np.array([0.05, 0.03])
    vertices, faces = part_mesh(body, 0, radii)
    corners = vertices[faces]
    volume = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    section, length = np.prod(body.sections[0]), float(body.lengths[0])
    cone = np.pi / 3 * length * section * (radii**2).sum() + np.pi / 3 * length * section * radii.prod()
    # Triangles look outwards, and the rounded ends add little.
    assert cone < volume < 1.15 * cone
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    inner = np.unique(edges, axis=0, return_counts=True)[1]
    assert (inner <= 2).all()


def test_images_are_shown_as_a_pinhole_sees_them():
    camera = CameraSpec("a", (640, 480), (500.0, 520.0), (300.0, 250.0), 0.0, (-0.2, 0.05, 0.001, 0.0, 0.0), np.eye(3), np.zeros(3))
    point = np.array([[0.4, -0.25, 1.0]])
    image = np.zeros((480, 640, 3), np.uint8)
    column, row = project(camera, point)[0].round().astype(int)
    cv2.circle(image, (column, row), 6, (255, 255, 255), -1)
    small = flat(image, camera, 320)[..., 0].astype(float)
    assert small.shape == (240, 320)
    found = [np.average(np.arange(side), weights=small.sum(axis=axis)) for side, axis in ((320, 0), (240, 1))]
    expected = [159.5 + 250 * point[0, 0], 119.5 + 260 * point[0, 1]]
    assert np.abs(np.subtract(found, expected)).max() < 1.0


@pytest.mark.slow
def test_a_long_run_is_thinned_and_says_so(make_arm, monkeypatch):
    assert (Budget(750, 4).step(100), Budget(750, 4).step(300), Budget(750, 4).step(3000)) == (1, 2, 11)
    assert Budget(0, 0).step(300) == 1 and Budget(10**6, 4).step(50) == 50
    assert Budget(750, 4).side(10) == 400 and 150 < Budget(750, 4).side(200) < 250
    folder, frames = make_arm(), []
    monkeypatch.setattr(pages, "LARGEST", 10)
    path, remarks = written(folder, draws=1, watch=lambda places: frames.append(len(places)) or places)
    assert frames == [5, 3, 2, 1] and remarks[0].startswith("One frame in 8 of 5 is shown")
    assert remarks[0].endswith("A part of the recording has all its frames: --frames 0-0, for one.")
    assert path.stat().st_size < LARGEST == 10_000_000


def test_the_command(make_arm, capsys, tmp_path, monkeypatch):
    def said(*arguments):
        with pytest.raises(SystemExit) as stopped:
            main(["view", str(folder), *map(str, arguments)])
        return stopped.value.code, *capsys.readouterr()

    opened = []
    monkeypatch.setattr("webbrowser.open", lambda address: opened.append(address) or True)
    folder, mine = make_arm(), tmp_path / "mine.html"
    status, out, err = said("--frames", "1-2", "--draws", "3", "--open")
    path = folder / "view.html"
    assert (status, err) == (0, "") and out == f"{path}: {path.stat().st_size / 1e6:.1f} MB; open it in a browser.\n"
    assert record(path)["durationSeconds"] == pytest.approx(2 / 60) and opened == [path.as_uri()]
    # Own pages are replaced, other files are not.
    assert said("--frames", "1", "--draws", "0")[0] == 0 and record(path)["durationSeconds"] == 0 and "/Draws" not in names(path)
    mine.write_text("mine")
    assert said("--out", mine)[0] == 2 and mine.read_text() == "mine"
    for frames in ("3-9", "2-1", "0", "x"):
        status, out, err = said("--frames", frames)
        assert (status, out) == (2, "") and "frames from 0 to 4" in err
    assert said("--draws", "-1")[0] == said("--draws", "1001")[0] == 2


@pytest.mark.slow
def test_several_people_in_one_scene(make_run, keypoint_session, tmp_path, capsys):
    """Each has a colour and a name, and is shown only in the frames in which the person is there."""
    run = make_run(dofs=ARM_DOFS, units=RADIANS, recording=keypoint_session)
    runs = [person_run(run, tmp_path / "study", number, frames) for number, frames in ((1, range(3)), (2, range(2, 5)))]
    with pytest.raises(SystemExit) as stopped:
        main(["view", *map(str, runs), "--draws", "6"])
    path = tmp_path / "study" / "people_3d.html"
    assert stopped.value.code == 0 and capsys.readouterr().out == f"{path}: {path.stat().st_size / 1e6:.1f} MB; open it in a browser.\n"
    page = record(path)
    assert page["durationSeconds"] == pytest.approx(5 / 60)
    layers = names(path)
    assert {"/Person 1, draws", "/Person 2, draws", "/Names/person 1", "/Names/person 2", "/Triangulated keypoints"} <= layers
    assert not layers & {"/Draws", "/Mean body"}
    for number in (1, 2):
        meshes = [
            message
            for _, message in page["messages"]
            if message["type"] == "MeshMessage" and message["name"].startswith(f"/Person {number}, mean body/")
        ]
        assert len(meshes) == 3 and {tuple(mesh["props"]["color"]) for mesh in meshes} == {person_colour(number)}
    # Before the second comes, nothing of that person is there; the first one is hidden when she leaves.
    seconds = [second for second, message in page["messages"] if str(message.get("name", "")).startswith("/Person 2")]
    assert min(seconds) == pytest.approx(2 / 60)
    hidden = [
        (second, message["name"])
        for second, message in page["messages"]
        if message.get("updates", {}).get("visible") is False or (message["type"] == "SetSceneNodeVisibilityMessage" and not message["visible"])
    ]
    assert {name for second, name in hidden if second == pytest.approx(3 / 60)} >= {"/Person 1, draws", "/Names/person 1"}
    assert "person 2, frames 2 to 4" in path.read_text(encoding="utf-8")
