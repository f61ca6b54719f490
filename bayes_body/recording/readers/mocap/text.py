"""Read motion capture files and the numbers in them. A file that is missing, too large, not text or not numeric raises an InputError."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import InputError, input_error
from bayes_body.base.files.read import read_bytes as read_regular

# Twice the size of an hour with a hundred markers.
LARGEST_BYTES = 1_000_000_000
# No length, angle or rate of a person is so large; larger numbers make sums and squares overflow.
LARGEST_NUMBER = 1e9


def read_bytes(path: Path, kind: str) -> bytes:
    """The file's content.

    Args:
        path: the file.
        kind: what it should be, such as `a BVH file`.

    Raises:
        InputError: no such file, not a regular file, unreadable, or longer than 1 GB.
    """
    return read_regular(path, kind, LARGEST_BYTES)


def read_text(path: Path, kind: str) -> str:
    """The file's text: UTF-8, or else Latin-1. Only names and comments contain more than ASCII.

    Raises:
        InputError: as for `read_bytes`, or the file is not text.
    """
    content = read_bytes(path, kind)
    if b"\0" in content:
        line = content[: content.index(b"\0")].count(b"\n") + 1
        raise input_error(f"{path}: line {line}", "the byte 0x00: not text", kind, "name another file, or restore this one")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("latin-1")


def numbers(entry: str, words: Sequence[str], remedy: str = "correct it, or restore the file") -> Float[np.ndarray, " word"]:
    """The words as numbers.

    Args:
        entry: the file and the line, for the message.
        words: the words of the line.
        remedy: what the user can do.

    Raises:
        InputError: a word is not a finite number, or beyond 1e9.
    """
    try:
        values = np.array(words, dtype=np.float64)
    except ValueError:
        raise input_error(entry, f"'{_first_bad(words)[:40]}'", "numbers", remedy) from None
    bad = ~(np.abs(values) <= LARGEST_NUMBER)
    if bad.any():
        raise input_error(entry, words[int(bad.argmax())][:40], f"finite numbers, at most {LARGEST_NUMBER:g}", remedy)
    return values


def table(entry: str, rows: Sequence[Sequence[str]], lines: Sequence[int]) -> Float[np.ndarray, "row word"]:
    """Rows of words, all of the same length, as numbers; `lines` are their line numbers in the file.

    Raises:
        InputError: as for `numbers`, naming the line.
    """
    # The fast conversion fails on rows of different lengths and on words that are not numbers. Only then find the faulty row, below.
    with suppress(ValueError):
        values = np.array(rows, dtype=np.float64)
        if (np.abs(values) <= LARGEST_NUMBER).all():
            return values
    for row, line in zip(rows, lines, strict=True):
        numbers(f"{entry}: line {line}", row)
    raise InputError(f"{entry}: not a table of numbers; restore the file.")


def _first_bad(words: Sequence[str]) -> str:
    for word in words:
        try:
            float(word)
        except ValueError:
            return word
    return ""
