"""Calibrations in OpenCV's files (`cv::FileStorage`: yml, yaml, xml, json): one per camera, or EasyMocap's pair `intri.yml`, `extri.yml`.

Camera matrix, distortion, rotation (matrix or Rodrigues vector) and translation, $X_{camera} = R X_{world} + T$. Each has several accepted names.
EasyMocap's names end in `_CAMERA`. The files do not state the unit of the translation.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from bayes_body.base.errors import InputError, input_error
from bayes_body.base.files.atomic import make_folder, replacing
from bayes_body.base.files.read import read_text
from bayes_body.recording.readers.calibration.calibrated import Calibrated, calibrated, rotation_given_twice
from bayes_body.recording.readers.faults import Faults
from bayes_body.recording.readers.images import SILENT
from bayes_body.recording.session.session import CameraSpec

KIND = "a calibration in OpenCV's yml, xml or json"
SUFFIXES = (".yml", ".yaml", ".xml", ".json")
INTRINSICS, EXTRINSICS = "intri", "extri"
# The first of these names that a file has is used.
MATRIX = ("camera_matrix", "cameraMatrix", "camera_Matrix", "Camera_Matrix", "intrinsic_matrix", "K", "M", "M1")
DISTORTION = ("distortion_coefficients", "Distortion_Coefficients", "dist_coeffs", "distCoeffs", "distortion", "dist", "D", "D1")
ROTATION = ("R", "rotation_matrix", "rotation", "rvec", "rotation_vector")
VECTOR = ("rvec", "rotation_vector")
TRANSLATION = ("T", "tvec", "translation", "translation_vector", "t")
WIDTH, HEIGHT = ("image_width", "image_Width", "width"), ("image_height", "image_Height", "height")
SIZE = ("image_size", "imageSize", "size")
# Larger than any array of a camera.
MOST_NUMBERS = 100
# OpenCV's reader recurses and crashes where a file is nested some ten thousand deep. A camera has some 20 brackets or tags; YAML can also nest by
# indentation, which needs as many bytes as the square of the depth.
MOST_OPENED, LARGEST_BYTES = 10_000, 2_000_000
OPENING = re.compile(r"[\[{<]|-[ \t\n]")


def read_opencv(path: Path, unit_m: float) -> list[Calibrated]:
    """The cameras of a file, of a folder with one file per camera (named as its file), or of EasyMocap's pair; sorted by name.

    Args:
        path: the file or folder.
        unit_m: metres in the files' unit of length.

    Raises:
        InputError: no such path, or no calibration in it.
        FaultyFileError: one sentence for each fault.
    """
    if not path.is_dir():
        return [_single(path, unit_m)]
    files = sorted(file for file in path.iterdir() if file.suffix.lower() in SUFFIXES and file.is_file())
    pair = {file.stem: file for file in files if file.stem in (INTRINSICS, EXTRINSICS)}
    if len(pair) == 2:
        return _easymocap(pair[INTRINSICS], pair[EXTRINSICS], unit_m)
    if not files:
        raise input_error(path, "no yml, yaml, xml or json file in it", f"{KIND} for each camera", "name the folder that holds them")
    faults, cameras = Faults(), []
    for file in files:
        with faults.collect():
            cameras.append(_single(file, unit_m))
    faults.raise_any()
    return cameras


def rewrite_opencv(source: Path, target: Path, cameras: Mapping[str, CameraSpec], unit_m: float) -> None:
    """Write a copy of a folder that `read_opencv` reads, with other cameras. It has the keys of the files, under the same names.

    Args:
        source: the folder.
        target: the folder of the copies; created if needed.
        cameras: the new cameras, by name. Files of others are copied.
        unit_m: metres in the files' unit of length.

    Raises:
        InputError: a file cannot be read, or a copy cannot be written.
    """
    make_folder(target)
    files = sorted(file for file in source.iterdir() if file.suffix.lower() in SUFFIXES and file.is_file())
    is_pair = {INTRINSICS, EXTRINSICS} <= {file.stem for file in files}
    for path in files:
        if is_pair and path.stem not in (INTRINSICS, EXTRINSICS):
            continue
        chosen = {f"_{name}": camera for name, camera in cameras.items()} if is_pair else {"": cameras[path.stem]} if path.stem in cameras else {}
        numbers = {key: value for end, camera in chosen.items() for key, value in _numbers_of(camera, end, unit_m).items()}
        _rewrite(_open(path), target / path.name, numbers)


def _numbers_of(camera: CameraSpec, end: str, unit_m: float) -> dict[str, NDArray[np.float64]]:
    """Return the new value of each key that may hold one of a camera."""
    (fx, fy), (cx, cy) = camera.focal_px, camera.centre_px
    R, T = np.asarray(camera.rotation, float), np.asarray(camera.translation_m, float) / unit_m
    values = dict.fromkeys(MATRIX, np.array([[fx, camera.skew * fx, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]))
    values |= dict.fromkeys(("Rot", *ROTATION), R) | dict.fromkeys(TRANSLATION, T)
    return {f"{name}{end}": value for name, value in values.items()}


def _rewrite(file: "_File", target: Path, numbers: Mapping[str, NDArray[np.float64]]) -> None:
    with replacing(target) as partial:
        storage = cv2.FileStorage(str(partial), cv2.FILE_STORAGE_WRITE)
        for key in _keys(file):
            node, entry = file.root.getNode(key), f"{file.path}: {key}"
            if key in numbers:
                stored = _numbers(entry, node)
                # A rotation stands there as a matrix or as a vector.
                is_vector = numbers[key].shape == (3, 3) and stored.size == 3
                storage.write(key, (cv2.Rodrigues(numbers[key])[0] if is_vector else numbers[key]).reshape(np.atleast_2d(stored).shape))
            elif node.isString():
                storage.write(key, _text(node))
            elif node.isInt():
                storage.write(key, int(node.real()))
            elif node.isReal():
                storage.write(key, node.real())
            elif node.isSeq() and node.size() and node.at(0).isString():
                storage.startWriteStruct(key, cv2.FILE_NODE_SEQ)
                for index in range(node.size()):
                    storage.write("", _text(node.at(index)))
                storage.endWriteStruct()
            else:
                storage.write(key, np.atleast_2d(_numbers(entry, node)))
        storage.release()


class _File(NamedTuple):
    """An open file: its path, its top level, and the storage, which OpenCV's nodes need to stay valid."""

    path: Path
    root: cv2.FileNode
    storage: cv2.FileStorage

    def numbers(self, names: Sequence[str], missing: str | None = None) -> NDArray[np.float64] | None:
        """The array under the first of the names that the file has. If there is none: an error that calls it `missing`, or None without `missing`."""
        for name in names:
            node = self.root.getNode(name)
            if not node.isNone():
                return _numbers(f"{self.path}: {name}", node)
        if missing is not None:
            raise input_error(self.path, f"no {missing}", f"one under a name such as {names[0]}", "add it, or name another file")
        return None


def _single(path: Path, unit_m: float) -> Calibrated:
    file = _open(path)
    if any(not file.root.getNode(name).isNone() for name in ("M2", "D2")):
        raise input_error(
            path, "the intrinsics of a stereo pair (M1, M2)", "a file for each camera", "write each camera with its R and T to a separate file"
        )
    return _camera(str(path), path.stem, (file, file), "", unit_m)


def _easymocap(intrinsics: Path, extrinsics: Path, unit_m: float) -> list[Calibrated]:
    files = _open(intrinsics), _open(extrinsics)
    names = _names(files[0])
    faults, cameras = Faults(), []
    for name in names:
        with faults.collect():
            cameras.append(_camera(f"{intrinsics.parent}: camera '{name}'", name, files, f"_{name}", unit_m))
    faults.raise_any()
    return cameras


def _names(file: _File) -> list[str]:
    """Names of the cameras in EasyMocap's intri.yml: its list `names`, or the ends of its keys K_CAMERA."""
    node = file.root.getNode("names")
    if node.isSeq():
        nodes = [node.at(i) for i in range(min(node.size(), 10 * MOST_NUMBERS))]
        endings = [key.removeprefix("K_") for key in _keys(file) if key.startswith("K_")]
        names = [_with_zeros(_text(item), endings) for item in nodes]
    else:
        names = [key.removeprefix("K_") for key in _keys(file) if key.startswith("K_")]
    if not names:
        raise input_error(file.path, "no camera in it", "EasyMocap's list `names`, with K_NAME and dist_NAME for each", "name another folder")
    return names


def _with_zeros(name: str, endings: Sequence[str]) -> str:
    """Return the camera's name. YAML reads 01 without quotes as the number 1, while the key is K_01."""
    if name in endings or not name.isdigit():
        return name
    padded = [key for key in endings if key.isdigit() and int(key) == int(name)]
    return padded[0] if len(padded) == 1 else name


def _text(node: cv2.FileNode) -> str:
    try:
        return node.string() if node.isString() else f"{node.real():g}" if node.isInt() else ""
    except UnicodeDecodeError:
        return ""


def _keys(file: _File) -> tuple[str, ...]:
    try:
        return tuple(file.root.keys()) if file.root.isMap() else ()
    except UnicodeDecodeError:
        return ()


def _camera(entry: str, name: str, files: tuple[_File, _File], end: str, unit_m: float) -> Calibrated:
    """The camera whose keys end in `end`, from the files of its intrinsics and extrinsics."""
    inner, outer = files
    matrix = inner.numbers(_ending(MATRIX, end), "camera matrix")
    distortion = inner.numbers(_ending(DISTORTION, end), "distortion coefficients")
    T = outer.numbers(_ending(TRANSLATION, end), "translation from the world to the camera; intrinsics without extrinsics do not place a camera")
    assert matrix is not None and distortion is not None and T is not None
    return calibrated(entry, name, _size(inner, end), matrix, distortion, _rotation(entry, outer, end), unit_m * T)


def _ending(names: Sequence[str], end: str) -> list[str]:
    return [f"{name}{end}" for name in names]


def _rotation(entry: str, file: _File, end: str) -> NDArray[np.float64]:
    # EasyMocap writes the vector as R_CAMERA and the matrix as Rot_CAMERA.
    first = file.numbers(_ending((*(("Rot",) if end else ()), *ROTATION), end), "rotation from the world to the camera")
    second = file.numbers(_ending((*VECTOR, *(("R",) if end else ())), end))
    assert first is not None
    return first if second is None or first.size == second.size else rotation_given_twice(entry, first, second)


def _size(file: _File, end: str) -> list[float] | None:
    size = file.numbers(_ending(SIZE, end))
    if size is not None:
        return size.ravel().tolist()
    sides = [file.numbers(_ending((*names, letter), end)) for names, letter in ((WIDTH, "W"), (HEIGHT, "H"))]
    return np.concatenate([side.ravel() for side in sides if side is not None]).tolist() if any(side is not None for side in sides) else None


def _open(path: Path) -> _File:
    text = read_text(path, KIND, LARGEST_BYTES)
    if (opened := sum(1 for _ in OPENING.finditer(text))) > MOST_OPENED:
        raise input_error(path, f"{opened} brackets, tags or items", f"{KIND} with at most {MOST_OPENED}", "restore the file")
    storage = cv2.FileStorage()
    try:
        with SILENT:
            opened = storage.open(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    except (cv2.error, SystemError, UnicodeDecodeError) as error:
        raise _not_read(path, str(error)) from None
    root = storage.root() if opened else None
    if root is None or not root.isMap():
        raise _not_read(path, "nothing in it")
    return _File(path, root, storage)


def _not_read(path: Path, reason: str) -> InputError:
    return input_error(path, f"cannot be read by OpenCV ({reason.strip().splitlines()[-1].split(') ')[-1]})", KIND, "restore the file")


def _numbers(entry: str, node: cv2.FileNode) -> NDArray[np.float64]:
    """The numbers of a node: an array (rows, columns), stored as rows, columns and data; a list of numbers or of lists; or a single number, (1,)."""
    if node.isMap():
        # FileNode.mat() is not safe: it trusts rows and columns, and would allocate what a damaged file asks for.
        rows, columns = (node.getNode(key) for key in ("rows", "cols"))
        shape = [int(side.real()) if side.isInt() else 0 for side in (rows, columns)]
        numbers = np.array(list(_flat(entry, node.getNode("data"))))
        if numbers.size != shape[0] * shape[1]:
            raise input_error(entry, f"{numbers.size} numbers for {shape[0]} rows and {shape[1]} columns", "an array of numbers", "restore the file")
        return numbers.reshape(shape)
    numbers = np.array(list(_flat(entry, node)))
    return numbers.reshape(3, 3) if node.isSeq() and numbers.size == 9 else numbers


def _flat(entry: str, node: cv2.FileNode, depth: int = 0) -> Iterator[float]:
    if node.isSeq() and depth < 3 and node.size() <= MOST_NUMBERS:
        for i in range(node.size()):
            yield from _flat(entry, node.at(i), depth + 1)
    elif node.isInt() or node.isReal():
        yield node.real()
    else:
        raise input_error(entry, "no numbers", f"at most {MOST_NUMBERS} numbers", "restore the file")
