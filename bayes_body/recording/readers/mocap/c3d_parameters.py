"""The parameters of a C3D file (c3d.org, user guide): groups of named arrays, in the byte order of the processor that wrote them.

They are not read with ezc3d: a damaged file can make it loop forever or crash.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bayes_body.base.errors import input_error

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
        ahead = int(content.values("u2", follows, 1)[0])
        yield owner, name, follows + 2
        if not ahead:
            return
        start = follows + ahead


def _array(content: Content, offset: int) -> NDArray[np.generic]:
    code, dimensions = (int(value) for value in content.values("i1", offset, 2))
    if code not in TYPES or not 0 <= dimensions <= 7:
        raise input_error(
            content.path, f"a parameter of type {code} with {dimensions} dimensions", f"one of the types {', '.join(map(str, TYPES))}", RESTORE
        )
    shape = [int(side) for side in content.values("u1", offset + 2, dimensions)]
    count = int(np.prod(shape, dtype=object))
    return content.values(TYPES[code], offset + 2 + dimensions, count).reshape(shape, order="F")
