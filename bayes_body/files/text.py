"""Read text files of other programs (calibrations, keypoints). A file that is missing, too large or not text raises an InputError."""

from pathlib import Path

from bayes_body.errors import input_error

# Much larger than any calibration or the keypoints of any frame.
LARGEST_BYTES = 20_000_000


def read_text(path: Path, kind: str) -> str:
    """The file's text.

    Args:
        path: the file.
        kind: what it should be, such as `a Qualisys calibration`.

    Raises:
        InputError: no such file, a folder, unreadable, longer than 20 MB, or not UTF-8.
    """
    try:
        if path.stat().st_size > LARGEST_BYTES:
            raise input_error(path, f"{path.stat().st_size} bytes", f"{kind} of at most {LARGEST_BYTES}", "name another file")
        content = path.read_bytes()
    except FileNotFoundError:
        raise input_error(path, "no such file", kind, "check the path") from None
    except OSError as error:
        raise input_error(path, f"cannot be read ({error.strerror})", kind, "check the path and its permissions") from None
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise input_error(f"{path}: line {line}", f"the byte 0x{content[error.start]:02x}", f"{kind}, text in UTF-8", "restore the file") from None
