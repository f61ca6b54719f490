"""Open files of unknown origin: regular files only, up to a stated size. All readers of a user's files start here.

A pipe would make a reader wait for ever, and a device such as /dev/zero never ends.

Text and JSON of other programs (calibrations, keypoints) are read here too. A file that is missing, too large or not text raises an InputError.
"""

import json
import os
import stat
from pathlib import Path
from typing import Any, BinaryIO

from bayes_body.base.errors import InputError, escaped, input_error

RESTORE = "check the path and its permissions"


class NoSuchFileError(InputError):
    """There is no file at a path."""


def open_regular(path: Path, kind: str, largest: int) -> BinaryIO:
    """Open a file for reading, without waiting for another process.

    Args:
        path: the file.
        kind: what it should be, such as `a video`, as the middle of a sentence.
        largest: the largest accepted size, bytes.

    Raises:
        NoSuchFileError: there is no such file.
        InputError: a folder, a pipe, a device, unreadable, or too large.
    """
    try:
        # Without O_NONBLOCK, opening a pipe waits for its writer.
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except FileNotFoundError:
        raise NoSuchFileError(str(input_error(path, "no such file", kind, "check the path"))) from None
    except OSError as error:
        raise input_error(path, _reason(path, error), kind, RESTORE) from None
    except ValueError as error:
        # The path has a null character, or one that the file system cannot encode.
        raise input_error(ascii(str(path)), str(error), kind, "check the path") from None
    file = os.fdopen(handle, "rb") if stat.S_ISREG(os.fstat(handle).st_mode) else None
    if file is None:
        problem = _special(os.fstat(handle).st_mode)
        os.close(handle)
        raise input_error(path, problem, kind, "name a regular file")
    if (size := os.fstat(handle).st_size) > largest:
        file.close()
        raise _too_large(path, f"{size} bytes", kind, largest)
    return file


def read_bytes(path: Path, kind: str, largest: int) -> bytes:
    """The content of a file. Arguments and errors are those of `open_regular`."""
    with open_regular(path, kind, largest) as file:
        try:
            content = file.read(largest + 1)
        except OSError as error:
            raise input_error(path, _reason(path, error), kind, RESTORE) from None
    # Some files of the operating system state no size.
    if len(content) > largest:
        raise _too_large(path, "more", kind, largest)
    return content


def native_path(path: Path) -> str:
    """The path for a library that opens the file itself. Such libraries take UTF-8 and crash on anything else.

    Raises:
        InputError: the path is not UTF-8, or the process does not use UTF-8.
    """
    text = str(path)
    try:
        text.encode()
    except UnicodeEncodeError:
        raise _not_utf8(text) from None
    return text


def check_native(path: Path) -> None:
    """Refuse a path that `native_path` refuses, also where only the current folder or a link's target is not UTF-8.

    Raises:
        InputError: the resolved path is not UTF-8, or the process does not use UTF-8.
    """
    native_path(path)
    try:
        resolved = path.resolve()
    except (OSError, RuntimeError, ValueError):
        # No current folder, links in a circle, a null character: whoever opens the path says so.
        return
    native_path(resolved)


def _not_utf8(text: str) -> InputError:
    try:
        meant = os.fsencode(text).decode()
    except UnicodeError:
        return input_error(ascii(text)[1:-1], "a byte that is not UTF-8 in the path", "a path in UTF-8", "rename the folder or the file")
    remedy = "set LC_ALL=C.UTF-8 or PYTHONUTF8=1, or use a path in ASCII"
    return input_error(escaped(meant), "a path in UTF-8, but Python's encoding of paths is another one", "a locale in UTF-8", remedy)


def _reason(path: Path, error: OSError) -> str:
    return "a folder" if path.is_dir() else f"cannot be read ({error.strerror or error})"


def _special(mode: int) -> str:
    if stat.S_ISDIR(mode):
        return "a folder"
    return "a pipe" if stat.S_ISFIFO(mode) else "a device" if stat.S_ISCHR(mode) or stat.S_ISBLK(mode) else "not a regular file"


def _too_large(path: Path, size: str, kind: str, largest: int) -> InputError:
    return input_error(path, size, f"{kind} of at most {largest} bytes", "name another file")


# Much larger than any calibration or the keypoints of any frame.
LARGEST_BYTES = 20_000_000


def read_text(path: Path, kind: str, largest: int = LARGEST_BYTES) -> str:
    """The file's text.

    Args:
        path: the file.
        kind: what it should be, such as `a Qualisys calibration`.
        largest: the largest accepted size, bytes.

    Raises:
        InputError: no such file, a folder, a pipe or a device, unreadable, too large, or not UTF-8.
    """
    content = read_bytes(path, kind, largest)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise input_error(
            f"{path}: line {line}", f"the byte 0x{content[error.start]:02x}", f"{kind}, text in UTF-8", "save the file as UTF-8, or restore it"
        ) from None


def parse_json(text: str, subject: object, kind: str, remedy: str = "restore the file") -> Any:
    """The value of a JSON text.

    Args:
        text: the file's content.
        subject: the file's name in the sentence.
        kind: what it should be.
        remedy: what the user can do.

    Raises:
        InputError: not JSON, nested too deep, or an integer with thousands of digits.
    """
    try:
        return json.loads(text)
    except RecursionError:
        raise input_error(subject, "not JSON that can be read (nested too deep)", kind, remedy) from None
    except json.JSONDecodeError as error:
        raise input_error(subject, f"not JSON ({error})", kind, remedy) from None
    except ValueError as error:
        raise input_error(subject, f"not JSON with valid numbers ({error})", kind, remedy) from None
