"""What the commands that learn from captured motion share: their options, the files that they read, and the record beside the arrays."""

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from bayes_body.base.errors import input_error

ENDINGS = (".amc", ".bvh", ".c3d", ".trc")
BODY = "person_31"

Out = Annotated[Path, typer.Option("--out", help="The .npz to write; a .toml beside it records its source.")]
Source = Annotated[str, typer.Option("--source", help="The source of the data, for the .toml.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")]


def check_out(out: Path, overwrite: bool) -> None:
    """Check that an .npz and the record beside it may be written.

    Raises:
        InputError: another ending, or a file that exists already.
    """
    if out.suffix != ".npz":
        raise input_error("--out", str(out), "a file that ends in .npz", "give such a name")
    for path in (out, out.with_suffix(".toml")):
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


def command_line(verb: str, words: Iterable[str], out: Path, body: str = BODY, options: Iterable[str] = ()) -> str:
    """Return the command that makes the arrays, without what is specific to this machine and without the default body."""
    body_words = [] if body == BODY else ["--body", body]
    return " ".join(["bayes-body learn", verb, *words, *body_words, *options, "--out", portable(out)])


def write_record(out: Path, comment: str, entries: Mapping[str, Any]) -> None:
    """Write the table beside the arrays: what they are, their source, and the command that makes them."""
    import tomlkit

    from bayes_body.base.files.atomic import write_text

    document = tomlkit.document()
    document.add(tomlkit.comment(comment))
    for key, value in entries.items():
        document[key] = value
    write_text(out.with_suffix(".toml"), tomlkit.dumps(document))
