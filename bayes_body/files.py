"""Folders and texts written for a user: what the file system refuses is said as a sentence."""

from pathlib import Path

from bayes_body.errors import InputError, wrong


def make_folder(path: Path) -> Path:
    """The folder, made with its parents if need be.

    Raises:
        InputError: it cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _refused(path, "made", error) from None
    return path


def write_text(path: Path, text: str) -> None:
    """Write a text in UTF-8.

    Raises:
        InputError: it cannot be written.
    """
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise _refused(path, "written", error) from None


def _refused(path: Path, done: str, error: OSError) -> InputError:
    return wrong(path, f"cannot be {done} ({error.strerror})", "a folder that can be written, with room", "name another folder, or free some space")
