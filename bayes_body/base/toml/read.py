"""Read TOML files that a user writes, and validate them with a pydantic schema. Each fault is reported in one sentence."""

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from bayes_body.base.errors import FaultyFileError, InputError, input_error
from bayes_body.base.files.read import read_text
from bayes_body.base.toml.faults import sentences, shown

# Much more than a run's file, which holds its session, definition and body; tomllib reads it in some seconds.
LARGEST_BYTES = 2_000_000
# tomllib's time grows with the square of the number of parts of a key a.b.c; no schema has more than four.
MOST_PARTS = 32
_PART = r"""(?:[A-Za-z0-9_-]+|"(?:[^"\\\n]|\\.)*"|'[^'\n]*')[ \t]*\.[ \t]*"""
LONG_KEY = re.compile(rf"(?<![A-Za-z0-9_-])(?:{_PART}){{{MOST_PARTS}}}")


def read_toml(path: Path) -> dict[str, Any]:
    """Return the tables of a TOML file.

    Raises:
        InputError: the file does not exist, is not a regular file, cannot be read, has more than 2 MB, is not UTF-8, or is not TOML (line and
            column are given).
    """
    return parse_toml(read_text(path, "a TOML file", LARGEST_BYTES), path)


def parse_toml(text: str, file: object) -> dict[str, Any]:
    """Return the tables of a TOML text.

    Args:
        text: the file's content.
        file: the name of the file in the sentence.

    Raises:
        InputError: the text is not TOML (line and column are given).
    """
    if key := LONG_KEY.search(text):
        place = f"{file}: line {text.count(chr(10), 0, key.start()) + 1}"
        raise input_error(place, f"a key of {MOST_PARTS} parts or more", "TOML, such as key = value or [table]", "restore the file")
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise _syntax_error(file, text, str(error)) from None
    except (ValueError, RecursionError) as error:
        # An integer with thousands of digits, or deeply nested lists.
        raise input_error(file, f"cannot be read ({error})", "TOML, such as key = value or [table]", "restore the file") from None


def _syntax_error(file: object, text: str, message: str) -> InputError:
    lines = text.split("\n")
    place = re.search(r"\s*\(at (?:line (\d+), column (\d+)|end of document)\)$", message)
    reason = message[: place.start()] if place else message
    if place and place[1]:
        line, column = int(place[1]), int(place[2])
    else:
        line, column = len(lines), len(lines[-1]) + 1
    line_text = shown(lines[line - 1].strip()).strip('"')
    twice = _given_twice(reason, lines[line - 1])
    if twice:
        return input_error(f"{file}: line {line}", *twice)
    problem = f"{reason[:1].lower()}{reason[1:]} in the line `{line_text}`"
    return input_error(f"{file}: line {line}, column {column}", problem, "TOML, such as key = value or [table]", "correct that line")


def _given_twice(reason: str, line: str) -> tuple[str, str, str] | None:
    """Return finding, expectation and remedy if tomllib's reason is a repeated key or table, else None."""
    inline = re.match(r"Duplicate inline table key '(.*)'", reason)
    header = re.match(r"\s*\[+([^\]]*)\]", line)
    if not inline and not reason.startswith(("Cannot overwrite a value", "Cannot declare")):
        return None
    if header and not inline:
        expected = "one header for each table"
        return f"the table [{header[1].strip()}] is given twice", expected, "put its keys under one header, or write [[...]] for each table of a list"
    key = inline[1] if inline else line.partition("=")[0].strip()
    return f"key '{key}' is given twice", "each key once in its table", "remove one of the two"


def validate[Schema: BaseModel](schema: type[Schema], data: Mapping[str, Any], file: str) -> Schema:
    """Return the data as an instance of `schema`.

    Args:
        schema: a pydantic model.
        data: tables from `read_toml`.
        file: the name of the file in the sentences.

    Raises:
        FaultyFileError: one sentence for each fault, in the order of the schema.
    """
    try:
        return schema.model_validate(data)
    except ValidationError as error:
        faults = sentences(schema, data, file, error.errors(include_url=False))
    raise FaultyFileError(faults)
