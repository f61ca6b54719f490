"""Read arrays of an .npz archive safely: no pickled objects, no trust in headers, limits on the unpacked size and on the number of arrays."""

import io
import math
import re
import struct
import zipfile
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from bayes_body.base.errors import InputError, input_error
from bayes_body.base.files.read import open_regular

LARGEST_BYTES = 500_000_000
# The directory of an archive has some 60 bytes for each array, and every entry of it becomes an object of Python.
LARGEST_DIRECTORY = 1_000_000
# Bytes of an array's header, and the number of headers that stay parsed: files of one kind share them.
LONGEST_HEADER, HEADERS_IN_MEMORY = 20_000, 256


def read_arrays(path: Path, keys: Sequence[str] | None, kind: str, remedy: str) -> dict[str, NDArray[np.generic]]:
    """Read the requested arrays that the archive contains.

    Args:
        path: the file.
        keys: names of the arrays; None for all.
        kind: what the file should be, as the middle of a sentence.
        remedy: what the user can do, as the end of a sentence.

    Raises:
        InputError: no such file, a pipe or a device, damaged, too large, or an array of objects.
    """
    with open_regular(path, kind, LARGEST_BYTES) as file:
        try:
            return _arrays(path, file, keys, kind, remedy)
        except InputError:
            raise
        except OSError as error:
            raise input_error(path, f"cannot be read ({error.strerror or error})", kind, "check the path and its permissions") from None
        except Exception as error:
            # A damaged archive can raise anything: zlib.error, struct.error, NotImplementedError, EOFError, ...
            raise input_error(path, f"not such an archive, or damaged ({type(error).__name__})", kind, remedy) from None


def _arrays(path: Path, file: BinaryIO, keys: Sequence[str] | None, kind: str, remedy: str) -> dict[str, NDArray[np.generic]]:
    if (directory := _directory_bytes(file)) > LARGEST_DIRECTORY:
        raise input_error(path, f"an archive with {directory} bytes of names", f"at most {LARGEST_DIRECTORY}", "name another file")
    with zipfile.ZipFile(file) as archive:
        size = sum(member.file_size for member in archive.infolist())
        if size > LARGEST_BYTES:
            raise input_error(path, f"{size} bytes when unpacked", f"at most {LARGEST_BYTES}", "name another file")
        names = [name.removesuffix(".npy") for name in archive.namelist()]
        members = names if keys is None else [key for key in keys if key in names]
        return {key: _parsed(f"{path}: {key}", _content(archive, f"{key}.npy"), kind, remedy) for key in members}


def _directory_bytes(file: BinaryIO) -> int:
    """The size of the archive's directory by the largest of its end records; 0 without one."""
    file.seek(0, io.SEEK_END)
    file.seek(max(0, file.tell() - 66_000))
    end = file.read()
    places = [match.start() for match in re.finditer(rb"PK\x05\x06", end)]
    return max((struct.unpack_from("<I", end, place + 12)[0] for place in places if place + 16 <= len(end)), default=0)


def _content(archive: zipfile.ZipFile, name: str) -> bytes:
    # Without a number of bytes, zipfile unpacks a false entry as far as it goes.
    with archive.open(name) as file:
        return file.read(archive.getinfo(name).file_size)


def _parsed(subject: str, content: bytes, kind: str, remedy: str) -> NDArray[np.generic]:
    # The length of the rest of the header follows eight bytes of magic string and version; it has two bytes in version 1, and four in later ones.
    begin = 10 if content[6:7] == b"\x01" else 12
    start = begin + int.from_bytes(content[8:begin], "little")
    if start > LONGEST_HEADER:
        raise ValueError("header")
    shape, fortran, dtype = _described(content[:start])
    count = math.prod(shape)
    values = len(content) - start
    if dtype.hasobject or not dtype.itemsize or count * dtype.itemsize != values:
        raise input_error(subject, f"{values} bytes of {dtype} for shape {shape}", kind, remedy)
    return np.frombuffer(content, dtype, count, start).reshape(shape, order="F" if fortran else "C")


@lru_cache(HEADERS_IN_MEMORY)
def _described(header: bytes) -> tuple[tuple[int, ...], bool, np.dtype[np.generic]]:
    """The shape, whether the order is Fortran's, and the type. To parse a header takes longer than to read a small array."""
    file = io.BytesIO(header)
    version = npy.read_magic(file)
    read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, fortran, dtype = read(file)
    return tuple(int(side) for side in shape), fortran, dtype
