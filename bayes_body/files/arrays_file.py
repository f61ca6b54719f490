"""Read arrays of an .npz archive safely: no pickled objects, no trust in headers, a limit on the unpacked size."""

import io
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from bayes_body.errors import InputError, input_error

LARGEST_BYTES = 500_000_000


def read_arrays(path: Path, keys: Sequence[str] | None, kind: str, remedy: str) -> dict[str, NDArray[np.generic]]:
    """Read the requested arrays that the archive contains.

    Args:
        path: the file.
        keys: names of the arrays; None for all.
        kind: what the file should be, as the middle of a sentence.
        remedy: what the user can do, as the end of a sentence.

    Raises:
        InputError: no such file, damaged, too large, or an array of objects.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(member.file_size for member in archive.infolist())
            if size > LARGEST_BYTES:
                raise input_error(path, f"{size} bytes when unpacked", f"at most {LARGEST_BYTES}", "name another file")
            names = [name.removesuffix(".npy") for name in archive.namelist()]
            members = names if keys is None else [key for key in keys if key in names]
            return {key: _parsed(f"{path}: {key}", _content(archive, key), kind, remedy) for key in members}
    except InputError:
        raise
    except FileNotFoundError:
        raise input_error(path, "no such file", kind, "check the path") from None
    except OSError as error:
        raise input_error(path, f"cannot be read ({error.strerror or error})", kind, "check the path and its permissions") from None
    except Exception as error:
        # A damaged archive can raise anything: zlib.error, struct.error, NotImplementedError, EOFError, ...
        raise input_error(path, f"not such an archive, or damaged ({type(error).__name__})", kind, remedy) from None


def _content(archive: zipfile.ZipFile, key: str) -> bytes:
    with archive.open(f"{key}.npy") as file:
        return file.read(LARGEST_BYTES)


def _parsed(where: str, content: bytes, kind: str, remedy: str) -> NDArray[np.generic]:
    file = io.BytesIO(content)
    version = npy.read_magic(file)
    read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, fortran, dtype = read(file)
    count = int(np.prod([int(side) for side in shape], dtype=object))
    values = content[file.tell() :]
    if dtype.hasobject or not dtype.itemsize or count * dtype.itemsize != len(values):
        raise input_error(where, f"{len(values)} bytes of {dtype} for shape {shape}", kind, remedy)
    return np.frombuffer(values, dtype).reshape(shape, order="F" if fortran else "C")
