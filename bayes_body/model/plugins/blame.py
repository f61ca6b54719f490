"""Errors in a plugin's code as sentences that name its file and the line: at loading, when a term is built, and whenever its functions are called."""

import functools
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import CodeType
from typing import Any, NamedTuple

from bayes_body.base.errors import InputError, input_error
from bayes_body.base.registry import Room

# The line of an error's text that says what was raised, where the text is that of a whole traceback.
RAISED = re.compile(r"^[A-Za-z_][\w.]*(Error|Exception|Exit|Warning)\b.*", re.MULTILINE)


class Origin(NamedTuple):
    """Where a term comes from: the file, its text when it was run, and the term's room and name."""

    path: Path
    text: str
    room: Room
    name: str

    def describe(self, function: Any = None) -> str:
        """Return the term's name in error messages, with the line at which a function of the plugin begins."""
        line = first_line(self.path, function)
        return f"{self.path}: {f'line {line}, ' if line else ''}{self.room} '{self.name}'"


@dataclass(frozen=True)
class Own:
    """A function of a plugin. An error in it is an InputError that names the line.

    Attributes:
        origin: the term to which it belongs.
        function: the plugin's function. Two wrappers of one function are equal, so that a model that is built again is not compiled again.
        check: raises an InputError if the function's result cannot be used: `(subject, result)`.
    """

    origin: Origin
    function: Callable[..., Any]
    check: Callable[[str, Any], None] | None = None

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        """Call the function.

        Raises:
            InputError: it fails, or returns something else than it must.
        """
        try:
            output = self.function(*arguments, **named)
        except InputError:
            # A fault of the recording, which the function only asked for.
            raise
        except (Exception, SystemExit) as error:
            fault = blamed(self.origin.path, self.origin.text, error, self.function)
            if fault is None:
                raise
            raise fault from error
        if self.check is not None:
            self.check(self.origin.describe(self.function), output)
        return output


def blamed(path: Path, text: str, error: BaseException, function: Any = None) -> InputError | None:
    """Return the sentence about an error that a plugin's code raised, or that calling one of its functions did; None if it came from elsewhere.

    Args:
        path: the plugin's file.
        text: its content.
        error: the error.
        function: the function of the plugin that was called; where it refuses its arguments, none of its lines has run.
    """
    line = line_of(path, error) or (first_line(path, function) if isinstance(error, TypeError) else None)
    return failure(path, text, error, line) if line else None


def failure(path: Path, text: str, error: BaseException, line: int | None) -> InputError:
    """Return the sentence about an error: what was raised, and at which line of the plugin."""
    if isinstance(error, InputError):
        return InputError(f"{path}: {f'line {line}: ' if line else ''}{error}")
    lines = text.splitlines()
    location = f": line {line}, `{lines[line - 1].strip()}`" if line and line <= len(lines) else ""
    return input_error(f"{path}{location}", _said(error).rstrip("."), "code that runs", "correct the plugin")


def _said(error: BaseException) -> str:
    """Return the kind of error and the first line of its text."""
    text = str(error).strip()
    raised = list(RAISED.finditer(text)) if "Traceback (most recent call last)" in text else []
    if raised:
        # A function that the host runs for a compiled program: its error comes back as a text.
        return raised[-1][0]
    return f"{type(error).__name__}: {text.splitlines()[0]}" if text else type(error).__name__


def line_of(path: Path, error: BaseException) -> int | None:
    """Return the last line of a file through which an error came, by its traceback, those of its causes, or a traceback in its text."""
    texts = []
    for cause in _with_causes(error):
        if line := _line_in_traceback(path, cause):
            return line
        texts.append(str(cause))
    named = [int(number) for text in texts for number in re.findall(rf'File "{re.escape(str(path))}", line (\d+)', text)]
    return named[-1] if named else None


def _with_causes(error: BaseException | None) -> Iterator[BaseException]:
    seen_ids = set[int]()
    while error is not None and id(error) not in seen_ids:
        seen_ids.add(id(error))
        yield error
        error = error.__cause__ or (None if error.__suppress_context__ else error.__context__)


def _line_in_traceback(path: Path, error: BaseException) -> int | None:
    line, trace, raised = None, error.__traceback__, False
    while trace is not None:
        raised = trace.tb_frame.f_code.co_filename == str(path)
        line = trace.tb_lineno if raised else line
        trace = trace.tb_next
    # A signal may arrive in a plugin's code: only its own exit is its fault.
    return line if raised or not isinstance(error, SystemExit) else None


def first_line(path: Path, function: Any) -> int | None:
    """Return the line of a file at which a function begins; None if it is not defined there."""
    code = _code(function)
    return code.co_firstlineno if code is not None and code.co_filename == str(path) else None


def _code(function: Any) -> CodeType | None:
    while isinstance(function, functools.partial | Own):
        function = function.func if isinstance(function, functools.partial) else function.function
    function = getattr(function, "__func__", function)
    return getattr(function, "__code__", None) or getattr(vars(type(function)).get("__call__"), "__code__", None)
