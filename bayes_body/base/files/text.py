"""Read text and JSON of other programs (calibrations, keypoints). A file that is missing, too large or not text raises an InputError."""

import json
from pathlib import Path
from typing import Any

from bayes_body.base.errors import input_error
from bayes_body.base.files.read import read_bytes

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


def parse_json(text: str, where: object, kind: str, remedy: str = "restore the file") -> Any:
    """The value of a JSON text.

    Args:
        text: the file's content.
        where: the file's name in the sentence.
        kind: what it should be.
        remedy: what the user can do.

    Raises:
        InputError: not JSON, nested too deep, or an integer with thousands of digits.
    """
    try:
        return json.loads(text)
    except RecursionError:
        raise input_error(where, "not JSON that can be read (nested too deep)", kind, remedy) from None
    except json.JSONDecodeError as error:
        raise input_error(where, f"not JSON ({error})", kind, remedy) from None
    except ValueError as error:
        raise input_error(where, f"not JSON with valid numbers ({error})", kind, remedy) from None
