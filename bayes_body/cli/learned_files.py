"""Files of captured motion that a command learns from, and the files that it writes."""

import os
from pathlib import Path

from bayes_body.base.errors import input_error

ENDINGS = (".amc", ".bvh", ".c3d", ".trc")


def check_out(out: Path, table: Path, overwrite: bool) -> None:
    """Check that an .npz and the table beside it may be written.

    Raises:
        InputError: another ending, or a file that exists already.
    """
    if out.suffix != ".npz":
        raise input_error("--out", str(out), "a file that ends in .npz", "give such a name")
    for path in (out, table):
        if path.exists() and not overwrite:
            raise input_error(path, "already exists", "a file that does not exist yet", "name another, or give --overwrite")


def motion_files(path: Path) -> list[Path]:
    """Return a file itself, or the captured motions of a folder.

    Raises:
        InputError: the folder has none.
    """
    if not path.is_dir():
        return [path]
    files = sorted(file for file in path.iterdir() if file.suffix.lower() in ENDINGS)
    if not files:
        raise input_error(path, "no captured motion in it", f"files that end in {', '.join(ENDINGS)}", "name another folder")
    return files


def portable(path: Path) -> str:
    """Return the path without the part that is specific to this machine."""
    root = os.environ.get("BAYES_BODY_DATA")
    if root and path.resolve().is_relative_to(Path(root).resolve()):
        return f"$BAYES_BODY_DATA/{path.resolve().relative_to(Path(root).resolve())}"
    return path.name
