"""Damaged files: whatever is done to a file, its reader gives a result or says what is wrong, and does so soon."""

import io
import json
import random
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest

from bayes_body.errors import InputError
from bayes_body.evidence.markers import MARKERS
from bayes_body.recording.calibration import check_rig
from bayes_body.recording.calibration_opencv import read_opencv
from bayes_body.recording.calibration_qualisys import read_qualisys
from bayes_body.recording.calibration_toml import read_calibration_toml
from bayes_body.recording.keypoint_layouts import choose_layout
from bayes_body.recording.keypoints import read_people
from bayes_body.recording.parsec_files import read_calibration
from bayes_body.recording.truth import read_truth
from bayes_body.session.read import load_session

QUICK, MANY = 300, 10_000
# No reader takes a second; a loop without end would not stop at ten.
# What numbers become: not finite, far too large or small, empty, no number, more digits than an integer may have.
NUMBERS = (
    b"nan",
    b"inf",
    b"-inf",
    b"1e400",
    b"-1e300",
    b"1e-320",
    b"0",
    b"-1",
    b"",
    b"9" * 30,
    b"9" * 5000,
    b"true",
    b'"a"',
    b"[]",
    b"null",
    b"0x1f",
    b"\xff",
)
PIECES = (
    b"[",
    b"]",
    b"{",
    b"}",
    b"<",
    b">",
    b"&",
    b'"',
    b"'",
    b":",
    b",",
    b"\n",
    b"\0",
    b"---",
    b"%",
    b"!!",
    b"#",
    b"=",
    b"\xef\xbb\xbf",
    b"[" * 20_000,
)


def mutated(content: bytes, rng: random.Random) -> bytes:
    """The content with one to four things done to it."""
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        if len(data) < 2:
            break
        i, j = sorted(rng.sample(range(len(data)), 2))
        kind = rng.randrange(8)
        if kind == 0:
            data[i] ^= 1 << rng.randrange(8)
        elif kind == 1:
            data[i] = rng.randrange(256)
        elif kind == 2:
            del data[i:]
        elif kind == 3:
            data[i:i] = data[i : min(j, i + 2000)]
        elif kind == 4:
            del data[i : min(j, i + 200)]
        elif kind == 5:
            data[i:i] = rng.choice(PIECES)
        else:
            number(data, i, rng)
    return bytes(data)


def number(data: bytearray, start: int, rng: random.Random) -> None:
    """Replace the first number from `start` on."""
    digits = b"0123456789.-+e"
    first = next((k for k in range(start, len(data)) if data[k] in digits[:10]), None)
    if first is not None:
        last = next((k for k in range(first, len(data)) if data[k] not in digits), len(data))
        data[first:last] = rng.choice(NUMBERS)


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
        choose_layout(people, "BODY_25" if people.shape[1] == 25 else None)


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
}


def torture(reader: Reader, folder: Path, count: int, seed: int) -> int:
    """Read so many damaged files; how many were refused."""
    rng, path, refused = random.Random(seed), folder / reader.name, 0
    path.write_bytes(reader.content)
    reader.read(path)
    for _ in range(count):
        path.write_bytes(mutated(reader.content, rng))
        try:
            reader.read(path)
        except InputError:
            refused += 1
    return refused


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("kind", READERS)
def test_some_damaged_files(kind, tmp_path):
    assert torture(READERS[kind], tmp_path, QUICK, 1) > QUICK / 10


@pytest.mark.long
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("kind", READERS)
def test_many_damaged_files(kind, tmp_path):
    assert torture(READERS[kind], tmp_path, MANY, 2) > MANY / 10
