"""A user's own file is never replaced unless the user says so. A page of this program is known by a mark."""

from pathlib import Path

from bayes_body.base.errors import input_error
from bayes_body.base.files.atomic import refused

# A page has its mark within so many first bytes.
HEAD = 1000


def check_free(file: Path, overwrite: bool) -> None:
    """Check that a command may write a file that the user named.

    Args:
        file: the file.
        overwrite: whether an existing one may be replaced.

    Raises:
        InputError: it exists and may not be replaced, it is a folder, or the file system refuses its name.
    """
    try:
        folder, exists = file.is_dir(), file.exists() or file.is_symlink()
    # For example, the name is too long.
    except OSError as error:
        raise refused(file, "written", error) from None
    if folder:
        raise input_error(file, "a folder", "the name of a file", "name a file in it with --out")
    if exists and not overwrite:
        raise input_error(file, "already exists", "a file that does not exist yet", "name another with --out, or replace it with --overwrite")


def has_mark(file: Path, mark: bytes) -> bool:
    """Return whether a file begins like a page of this program."""
    try:
        # A pipe would have to be waited for.
        if not file.is_file():
            return False
        with file.open("rb") as opened:
            return mark in opened.read(HEAD)
    except OSError:
        return False
