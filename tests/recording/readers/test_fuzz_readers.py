"""Damaged and hostile files: whatever is done to a file, its reader gives a result or says what is wrong, and does so soon."""

import io
import json
import os
import random
import subprocess
import sys
import tempfile
import threading
import zipfile
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest
from mutations import mutated

from bayes_body.base.errors import InputError
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.readers.calibration.calibrated import check_rig
from bayes_body.recording.readers.calibration.opencv import read_opencv
from bayes_body.recording.readers.calibration.qualisys import read_qualisys
from bayes_body.recording.readers.calibration.toml import read_calibration_toml
from bayes_body.recording.readers.camera_path import read_camera_path
from bayes_body.recording.readers.images import read_colour
from bayes_body.recording.readers.keypoints.openpose import read_people
from bayes_body.recording.readers.keypoints.orders import CameraPoses, decide_orders
from bayes_body.recording.readers.keypoints.series import read_series
from bayes_body.recording.readers.mocap import read_motion
from bayes_body.recording.readers.parsec_files import read_calibration
from bayes_body.recording.readers.truth import read_truth
from bayes_body.recording.readers.videos.video import probe, read_video_frame
from bayes_body.recording.session.read import load_session

QUICK, MANY = 300, 10_000
# No reader takes a second; a loop without end would not stop at ten.
SOON_S = 60
# Readers that start a decoder, or cache what they read, for each file.
SLOW = {"video": 10}


class Reader(NamedTuple):
    """A sound file's name and content, and what is done with it."""

    name: str
    content: bytes
    read: object


def camera_matrix() -> np.ndarray:
    return np.array([[600.5, 0.0, 320.25], [0.0, 610.0, 240.0], [0.0, 0.0, 1.0]])


def toml() -> bytes:
    table = (
        '[cam_0{i}]\nname = "cam{i}"\nsize = [640.0, 480.0]\nmatrix = [[600.5, 0.0, 320.25], [0.0, 610.0, 240.0], [0.0, 0.0, 1.0]]\n'
        "distortions = [-0.1, 0.02, 0.001, -0.001]\nrotation = [0.1, -1.2, 0.3]\ntranslation = [0.{i}, 0.2, 3.5]\nfisheye = false\n\n"
    )
    return (table.format(i=1) + table.format(i=2) + "[metadata]\nadjusted = false\nerror = 0.0\n").encode()


def qualisys() -> bytes:
    camera = (
        '<camera serial="c{i}" model="Miqus Video" viewrotation="0"><fov_video left="0" top="0" right="1919" bottom="1087"/>'
        '<transform r11="1" r12="0" r13="0" r21="0" r22="1" r23="0" r31="0" r32="0" r33="1" x="{i}263.3" y="2283.8" z="1794.3"/>'
        '<intrinsic focalLengthU="107872.6" focalLengthV="107880.2" centerPointU="60827.2" centerPointV="32684.0" skew="0.0" '
        'radialDistortion1="-0.04" radialDistortion2="0.1" tangentalDistortion1="0.0006" tangentalDistortion2="-0.0004"/></camera>'
    )
    text = f"<?xml version='1.0' encoding='ASCII'?><calibration><cameras>{camera.format(i=1)}{camera.format(i=2)}</cameras></calibration>"
    return text.encode()


def opencv(suffix: str) -> bytes:
    file = cv2.FileStorage(suffix, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    file.write("image_width", 640)
    file.write("image_height", 480)
    for key, value in (("K", camera_matrix()), ("dist", np.full((1, 5), 0.01)), ("R", np.eye(3)), ("T", np.array([[0.1], [0.2], [3.0]]))):
        file.write(key, value)
    return file.releaseAndGetString().encode()


def openpose() -> bytes:
    rows = np.random.default_rng(0).uniform(1, 400, (2, 25, 3))
    rows[..., 2] /= 400
    people = [{"person_id": [-1], "pose_keypoints_2d": row.ravel().round(3).tolist(), "face_keypoints_2d": []} for row in rows]
    return json.dumps({"version": 1.3, "people": people}).encode()


def truth(save) -> bytes:
    content = io.BytesIO()
    save(content, markers=np.random.default_rng(0).normal(size=(3, 15, 3)), names=np.array(MARKERS))
    return content.getvalue()


def parsec() -> bytes:
    numbers = [600.0, 610.0, 320.0, 240.0, 0.0, -0.1, 0.02, 0.0, 0.0, 0.0, *np.eye(3).ravel(), 100.0, 200.0, 3000.0, 0.0, 0.0, 0.0]
    return "\n".join(map(str, numbers)).encode()


SESSION = b"""\
title = "one man"
up = "y"
fps = 25
frames = 3
truth = "truth.npz"

[subject]
height_m = 1.8

[subject.radii_m]
head = [0.1, 0.09]

[initial]
fit_lengths = true

[initial.angles_deg]
hip = -30.0

[initial.keypoints_px.left]
nose = [10.5, 20.0, 0.9]

[segmentation]
threshold = 12.0

[[camera]]
name = "left"
size_px = [640, 480]
focal_px = [600.0, 610.0]
centre_px = [319.5, 239.5]
rotation = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
translation_m = [0.1, -0.2, 4.5]
images = "left/%04d.png"
offset = 2
"""


def rigged(read):
    """Also that what is read can be a room."""
    return lambda path: check_rig(path, read(path))


def laid_out(path: Path) -> None:
    people = read_people(path)
    if len(people):
        poses = CameraPoses(people[..., :2], np.zeros(len(people), int))
        decide_orders({"a": poses}, people.shape[1], "BODY_25" if people.shape[1] == 25 else None)


def picture(suffix: str) -> bytes:
    image = np.random.default_rng(0).integers(0, 256, (24, 32, 3), np.uint8)
    return cv2.imencode(suffix, image)[1].tobytes()


def video() -> bytes:
    """A second of noise, by way of a file, since OpenCV writes no other."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.avi"
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (32, 24))
        for seed in range(10):
            writer.write(np.random.default_rng(seed).integers(0, 256, (24, 32, 3), np.uint8))
        writer.release()
        return path.read_bytes()


def archive(**arrays) -> bytes:
    content = io.BytesIO()
    np.savez(content, **arrays)
    return content.getvalue()


def played(path: Path) -> None:
    for number in range(min(probe(path).frames, 10)):
        read_video_frame(path, number)


READERS = {
    "toml": Reader("calib.toml", toml(), rigged(read_calibration_toml)),
    "qualisys": Reader("room.qca.txt", qualisys(), rigged(read_qualisys)),
    "opencv yml": Reader("a.yml", opencv(".yml"), rigged(lambda path: read_opencv(path, 1.0))),
    "opencv xml": Reader("a.xml", opencv(".xml"), rigged(lambda path: read_opencv(path, 1.0))),
    "opencv json": Reader("a.json", opencv(".json"), rigged(lambda path: read_opencv(path, 1.0))),
    "openpose": Reader("a.0000.json", openpose(), laid_out),
    "truth": Reader("truth.npz", truth(np.savez), lambda path: read_truth(path, 3)),
    "compressed truth": Reader("truth.npz", truth(np.savez_compressed), lambda path: read_truth(path, 3)),
    "session": Reader("session.toml", SESSION, load_session),
    "parsec": Reader("Camera1.cal", parsec(), read_calibration),
    "png": Reader("a.png", picture(".png"), lambda path: read_colour(path, (32, 24))),
    "bmp": Reader("a.bmp", picture(".bmp"), lambda path: read_colour(path, (32, 24))),
    "jpeg": Reader("a.jpg", picture(".jpg"), lambda path: read_colour(path, (32, 24))),
    "video": Reader("a.avi", video(), played),
    "keypoints": Reader("a.npz", archive(keypoints=np.full((3, 2, 3), 0.5), names=np.array(["nose", "neck"])), read_series),
    "path": Reader("p.npz", archive(rotation=np.tile(np.eye(3), (3, 1, 1)), translation_m=np.ones((3, 3))), lambda path: read_camera_path(path, 3)),
}


def torture(reader: Reader, folder: Path, count: int, seed: int) -> int:
    """Read so many damaged files; how many were refused."""
    rng, path, refused = random.Random(seed), folder / reader.name, 0
    path.write_bytes(reader.content)
    reader.read(path)
    for k in range(count):
        path.write_bytes(mutated(reader.content, rng))
        # Readers that cache what they read look at a file's time, which two writes may share.
        os.utime(path, ns=(k, k))
        try:
            reader.read(path)
        except InputError:
            refused += 1
    return refused


def refusal(read, path: Path) -> str:
    """What a reader says about a file that it must refuse, and soon."""
    said = []

    def call() -> None:
        try:
            said.append(f"read: {read(path)}")
        except InputError as error:
            said.append(str(error))

    thread = threading.Thread(target=call, daemon=True)
    thread.start()
    thread.join(SOON_S)
    assert said, f"{path}: no answer in {SOON_S} s"
    return said[0]


HOSTILE = READERS | {name: Reader(f"a.{name}", b"", lambda path: read_motion(path, unit="m")) for name in ("bvh", "c3d", "trc")}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("kind", READERS)
def test_some_damaged_files(kind, tmp_path):
    count = QUICK // SLOW.get(kind, 1)
    assert torture(READERS[kind], tmp_path, count, 1) > count / 10


@pytest.mark.long
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("kind", READERS)
def test_many_damaged_files(kind, tmp_path):
    count = MANY // SLOW.get(kind, 1)
    assert torture(READERS[kind], tmp_path, count, 2) > count / 10


@pytest.mark.parametrize("kind", HOSTILE)
def test_only_regular_files_of_a_sane_size_are_read(kind, tmp_path):
    name, _, read = HOSTILE[kind]
    os.mkfifo(tmp_path / name)
    assert f"{name}: a pipe; expected " in refusal(read, tmp_path / name)
    (tmp_path / name).unlink()
    (tmp_path / name).symlink_to("/dev/zero")
    assert f"{name}: a device; expected " in refusal(read, tmp_path / name)
    (tmp_path / name).unlink()
    if kind != "video":
        # It takes no space on the disk. Videos may be as long as the disk has room for.
        (tmp_path / name).touch()
        os.truncate(tmp_path / name, 3_000_000_000)
        assert f"{name}: 3000000000 bytes; expected " in refusal(read, tmp_path / name)


DEEP = 200_000
NESTED = {
    "opencv json": b'{"K": ' + b"[" * DEEP + b"1" + b"]" * DEEP + b"}",
    "opencv yml": b"%YAML:1.0\n---\nK: " + b"[" * DEEP + b"1" + b"]" * DEEP,
    "opencv yml in items": b"%YAML:1.0\n---\nK:\n   " + b"- " * DEEP + b"1\n",
    "opencv xml": b'<?xml version="1.0"?><opencv_storage>' + b"<K>" * DEEP + b"1" + b"</K>" * DEEP + b"</opencv_storage>",
    "qualisys": b"<calibration>" + b"<camera>" * DEEP + b"</camera>" * DEEP + b"</calibration>",
    "openpose": b'{"people": ' + b"[" * DEEP + b"]" * DEEP + b"}",
    "session": b"title = " + b"[" * DEEP + b"]" * DEEP,
    "session in tables": b"title = " + b"{a = " * DEEP + b"1" + b"}" * DEEP,
    "session with a long key": b"title" + b".a" * DEEP + b" = 1",
    "toml": b"[" + b"a." * DEEP + b"a]\nb = 1",
}
# Reads the file in its argument with the reader of that name. By itself, since a crash would take the tests with it.
ALONE = """
import sys
from pathlib import Path
from bayes_body.base.errors import InputError
from bayes_body.recording.readers.calibration.opencv import read_opencv
from bayes_body.recording.readers.images import is_image, read_colour
from bayes_body.recording.readers.videos.video import probe
from bayes_body.recording.session.read import load_session
readers = {"opencv": lambda path: read_opencv(path, 1.0), "image": read_colour, "is image": is_image, "video": probe, "session": load_session}
for kind, path in zip(sys.argv[1::2], sys.argv[2::2]):
    try:
        print(readers[kind](Path(path)) is not None)
    except InputError as error:
        print(ascii(str(error)))
"""


def alone(*arguments: object, **environment: str) -> list[str]:
    """What `ALONE` prints, a line for each reader."""
    command = [sys.executable, "-c", ALONE, *map(os.fsencode, map(str, arguments))]
    done = subprocess.run(command, capture_output=True, timeout=120, env={**os.environ, **environment}, check=False)
    assert done.returncode == 0, (done.returncode, done.stderr)
    return done.stdout.decode().splitlines()


@pytest.mark.parametrize("case", [case for case in NESTED if not case.startswith("opencv")])
def test_nested_documents(case, tmp_path):
    reader = READERS[case.split()[0]]
    (tmp_path / reader.name).write_bytes(NESTED[case])
    assert "expected" in refusal(reader.read, tmp_path / reader.name)


def test_nested_documents_do_not_crash_opencv(tmp_path):
    cases = {case: tmp_path / f"{k}.{case.split()[1]}" for k, case in enumerate(NESTED) if case.startswith("opencv")}
    for case, path in cases.items():
        path.write_bytes(NESTED[case])
    said = alone(*(part for path in cases.values() for part in ("opencv", path)))
    assert len(said) == len(cases)
    assert all("brackets, tags or items; expected a calibration in OpenCV's yml, xml or json with at most 10000" in line for line in said)


def test_paths_that_are_not_utf8(tmp_path):
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/walk\xff"))
    folder.mkdir()
    for kind in ("session", "png", "video"):
        (folder / READERS[kind].name).write_bytes(READERS[kind].content)
    said = alone("session", folder / "session.toml", "image", folder / "a.png", "is image", folder / "a.png", "video", folder / "a.avi")
    # Images and videos are read by Python, and need no other path.
    assert said[1] == said[3] == "True"
    assert all("a byte that is not UTF-8 in the path; expected a path in UTF-8; rename the folder" in line for line in (said[0], said[2]))


def test_paths_in_utf8_where_the_locale_is_not(tmp_path):
    (tmp_path / "gehört").mkdir()
    path = tmp_path / "gehört" / "a.png"
    path.write_bytes(READERS["png"].content)
    assert alone("is image", path) == ["True"]
    (line,) = alone("is image", path, LC_ALL="C", PYTHONUTF8="0", PYTHONCOERCECLOCALE="0")
    assert "a path in UTF-8, but Python's encoding of paths is another one; expected a locale in UTF-8; set LC_ALL=C.UTF-8" in line


def test_archives_that_lie(tmp_path):
    path = tmp_path / "truth.npz"

    def said(**members: bytes) -> str:
        with zipfile.ZipFile(path, "w") as file:
            for name, content in members.items():
                file.writestr(f"{name}.npy", content)
        return refusal(lambda path: read_truth(path, 3), path)

    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**14,)})
    assert "markers: 0 bytes of float64 for shape (100000000000000,); expected an .npz" in said(markers=header.getvalue(), names=header.getvalue())
    assert "bytes of names; expected at most 1000000" in said(**{f"{k:0>100}": b"" for k in range(8000)})
