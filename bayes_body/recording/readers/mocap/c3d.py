"""C3D (c3d.org), the binary format of motion laboratories: markers with POINT:UNITS and POINT:RATE. A point with a negative residual is missing.

Files of `bayes-body export` also hold each marker's spread as further points (`_sd`, `_q05`, `_q95`). These are not markers and are left out.

The parameters of a C3D file (c3d.org, user guide) are groups of named arrays, in the byte order of the processor that wrote them. They are not read
with ezc3d: a damaged file can make it loop forever or crash.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from bayes_body.base.errors import input_error
from bayes_body.recording.readers.mocap.capture import Capture, known_unit
from bayes_body.recording.readers.mocap.text import LARGEST_NUMBER, read_bytes

KIND = "a C3D file with points"
RESTORE = "restore the file, or export it again"
BLOCK = 512
INTEL, DEC, MIPS = 84, 85, 86
# Sizes of a parameter's values; -1: characters.
TYPES = {-1: "S1", 1: "i1", 2: "i2", 4: "f4"}


class Content(NamedTuple):
    """A file's bytes and the processor that wrote them.

    Attributes:
        path: the file.
        data: its whole content.
        processor: `INTEL`, `DEC` or `MIPS`.
    """

    path: Path
    data: bytes
    processor: int

    def values(self, kind: str, start: int, count: int) -> NDArray[np.generic]:
        """Read `count` values of a NumPy kind such as `u2`, starting at byte `start`, in the byte order of this machine.

        Raises:
            InputError: the file ends too early.
        """
        size = np.dtype(kind).itemsize * count
        if count < 0 or start < 0 or start + size > len(self.data):
            raise input_error(self.path, f"cut off: {len(self.data)} bytes", f"{max(start + size, 0)}, as the file itself states", RESTORE)
        piece = self.data[start : start + size]
        if kind == "f4" and self.processor == DEC:
            # DEC floats have their two words swapped, and an exponent that is larger by two.
            words = np.frombuffer(piece, "<u2").reshape(-1, 2)[:, ::-1]
            return np.ascontiguousarray(words).view("<f4")[:, 0] / 4
        order = ">" if self.processor == MIPS else "<"
        return np.frombuffer(piece, kind if kind[0] == "S" else np.dtype(kind).newbyteorder(order)).astype(kind)


def open_c3d(path: Path, data: bytes) -> tuple[Content, dict[str, NDArray[np.generic]]]:
    """The content, and its parameters by `GROUP:NAME`. Each has the shape that the file gives, first index fastest.

    Raises:
        InputError: not a C3D file, or one that is cut off in its parameters.
    """
    if len(data) < BLOCK or data[1] != 0x50:
        raise input_error(path, "no C3D header", KIND, "name another file")
    start = (max(data[0], 1) - 1) * BLOCK
    processor = data[start + 3] if start + 4 <= len(data) else 0
    if processor not in (INTEL, DEC, MIPS):
        raise input_error(path, f"processor {processor}", f"{INTEL} (Intel), {DEC} (DEC) or {MIPS} (MIPS): {KIND}", RESTORE)
    content = Content(path, data, processor)
    groups: dict[int, str] = {}
    values: dict[tuple[int, str], NDArray[np.generic]] = {}
    for owner, name, offset in _records(content, start + 4):
        if owner < 0:
            groups[-owner] = name
        else:
            values[owner, name] = _array(content, offset)
    return content, {f"{groups[owner]}:{name}": array for (owner, name), array in values.items() if owner in groups}


def _records(content: Content, start: int) -> Iterator[tuple[int, str, int]]:
    """For each record: its group (negative: the record is a group), its name, and where its content begins."""
    while True:
        length, owner = (int(value) for value in content.values("i1", start, 2))
        # A negative length means locked, which concerns only programs that write.
        length = abs(length)
        if not length or not owner:
            return
        name = content.values("u1", start + 2, length).tobytes().decode("latin-1").strip().upper()
        follows = start + 2 + length
        skip = int(content.values("u2", follows, 1)[0])
        yield owner, name, follows + 2
        if not skip:
            return
        start = follows + skip


def _array(content: Content, offset: int) -> NDArray[np.generic]:
    code, dimensions = (int(value) for value in content.values("i1", offset, 2))
    if code not in TYPES or not 0 <= dimensions <= 7:
        raise input_error(
            content.path, f"a parameter of type {code} with {dimensions} dimensions", f"one of the types {', '.join(map(str, TYPES))}", RESTORE
        )
    shape = [int(side) for side in content.values("u1", offset + 2, dimensions)]
    count = int(np.prod(shape, dtype=object))
    return content.values(TYPES[code], offset + 2 + dimensions, count).reshape(shape, order="F")


USUAL_UNIT, USUAL_UP = "mm", "z"
# Counts above 65535 frames are in a parameter of floats.
FRAMES, LABELS, UNITS, RATE, Y_SCREEN = "POINT:LONG_FRAMES", "POINT:LABELS", "POINT:UNITS", "POINT:RATE", "POINT:Y_SCREEN"
SPREAD = re.compile(r"(.+)_(sd|q05|q95)")

type Parameters = Mapping[str, NDArray[np.generic]]


def read_c3d(path: Path) -> Capture:
    """Read the markers. POINT:Y_SCREEN gives the up axis; the default is z.

    Raises:
        InputError: the file cannot be read, is not C3D, has no points, or is cut off.
    """
    content, parameters = open_c3d(path, read_bytes(path, KIND))
    labels = _labels(parameters)
    points, rate = _points(content, parameters)
    if not points.shape[1]:
        raise input_error(path, "no points in it", KIND, "export it with its markers")
    if len(labels) < points.shape[1]:
        raise input_error(f"{path}: {LABELS}", f"{len(labels)} names", f"{points.shape[1]}, one for each point", RESTORE)
    markers = [k for k, label in enumerate(labels[: points.shape[1]]) if label and not _is_spread(label, labels)]
    names = tuple(labels[k] for k in markers)
    if len(set(names)) < len(names) or not names:
        twice = next((name for name in names if names.count(name) > 1), "no name")
        raise input_error(f"{path}: {LABELS}", f"'{twice}' {names.count(twice)} times" if names else twice, "unique names", "rename them")
    unit = (_text(parameters, UNITS) or [USUAL_UNIT])[0] or USUAL_UNIT
    up = (_text(parameters, Y_SCREEN) or [""])[0].strip().lower().removeprefix("+")
    metres = known_unit(f"{path}: {UNITS}", unit)
    return Capture(rate, names, (-1,) * len(names), points[:, markers], metres, up if re.fullmatch("-?[xyz]", up) else USUAL_UP)


def _is_spread(label: str, labels: list[str]) -> bool:
    match = SPREAD.fullmatch(label)
    return match is not None and match[1] in labels


def _text(parameters: Parameters, key: str) -> list[str]:
    """The strings of a parameter, which are columns of characters."""
    array = parameters.get(key)
    if array is None or array.dtype.kind != "S" or not array.size:
        return []
    columns = array.reshape(array.shape[0] if array.ndim else 1, -1, order="F").T
    return [column.tobytes().decode("utf-8", "replace").replace("\0", " ").strip() for column in columns]


def _labels(parameters: Parameters) -> list[str]:
    """The names of all points. A parameter holds at most 255 names; the next ones are in LABELS2 and so on."""
    labels, number = _text(parameters, LABELS), 2
    while f"{LABELS}{number}" in parameters:
        labels += _text(parameters, f"{LABELS}{number}")
        number += 1
    # Some laboratories put the subject's name before each marker's.
    return [label.rpartition(":")[2] for label in labels]


def _number(parameters: Parameters, key: str, default: float) -> float:
    array = parameters.get(key)
    if array is None or array.dtype.kind == "S" or array.size != 1:
        return default
    return float(array.ravel()[0])


def _points(content: Content, parameters: Parameters) -> tuple[Float[np.ndarray, "frame point 3"], float]:
    """Positions in the file's unit, NaN where missing; and frames per second."""
    header = [int(word) for word in content.values("u2", 0, 12)]
    count, analog, first, last, start = header[1], header[2], header[3], header[4], header[8]
    scale, rate = (float(content.values("f4", offset, 1)[0]) for offset in (12, 20))
    frames = _number(parameters, FRAMES, last - first + 1)
    rate = _number(parameters, RATE, rate)
    if not (np.isfinite(scale) and scale and 1 <= frames < LARGEST_NUMBER and start >= 1):
        raise input_error(content.path, f"{frames:g} frames from block {start} on, scale {scale:g}", f"one or more frames of {KIND}", RESTORE)
    width, kind = 4 * count + analog, "f4" if scale < 0 else "i2"
    values = content.values(kind, (start - 1) * BLOCK, int(frames) * width).reshape(int(frames), width)
    points = values[:, : 4 * count].reshape(int(frames), count, 4).astype(np.float64)
    if not (np.abs(np.nan_to_num(points[..., :3], posinf=np.inf)) <= LARGEST_NUMBER).all():
        raise input_error(content.path, "a position that is too large", f"positions of at most {LARGEST_NUMBER:g}", RESTORE)
    positions = points[..., :3] * (1.0 if scale < 0 else scale)
    positions[~(points[..., 3] >= 0)] = np.nan
    return positions, rate
