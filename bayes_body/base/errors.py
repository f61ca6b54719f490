"""Errors about a user's input. Each names the input, its value, what was expected, and the remedy, in one sentence."""

import difflib
import unicodedata
from collections.abc import Iterable

# Categories of characters: controls (line breaks, tabs, escapes), surrogates, line and paragraph separators.
CONTROL = ("Cc", "Cs", "Zl", "Zp")


class InputError(ValueError):
    """Raised for input that cannot be used. The command line prints it as one sentence and exits with status 2."""


class RunWarning(UserWarning):
    """A sentence about a run that a user must read before the result is used."""


class FaultyFileError(InputError):
    """Raised with all faults of one file, one sentence each."""

    def __init__(self, sentences: Iterable[str]):
        self.sentences = tuple(sentences)
        super().__init__("\n".join(self.sentences))

    def __reduce__(self) -> tuple[type["FaultyFileError"], tuple[tuple[str, ...]]]:
        """Return what makes it again in another process: its sentences, not their text."""
        return type(self), (self.sentences,)


def input_error(subject: object, problem: str, expected: str, remedy: str) -> InputError:
    """Return the error `subject: problem; expected ...; remedy.`, one line: names in it may hold line breaks and other control characters."""
    return InputError(escaped(f"{subject}: {problem}; expected {expected}; {remedy}."))


def escaped(text: str) -> str:
    """Return a text from a file so that a terminal can show it: control characters as Python writes them."""
    return "".join(ascii(character)[1:-1] if unicodedata.category(character) in CONTROL else character for character in text)


def printable(text: str) -> str:
    """Return the text with all control characters escaped, except line breaks."""
    return "\n".join(map(escaped, text.split("\n")))


def nearest(name: str, names: Iterable[str]) -> str:
    """Return `did you mean 'x'?` if a known name is similar, else the list of known names."""
    names = sorted(names)
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.6)
    return f"did you mean '{close[0]}'?" if close else f"known: {', '.join(names) or 'none'}"
