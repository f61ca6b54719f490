"""Errors about a user's input. Each names the input, its value, what was expected, and the remedy, in one sentence."""

import difflib
from collections.abc import Iterable


class InputError(ValueError):
    """Raised for input that cannot be used. The command line prints it as one sentence and exits with status 2."""


class FaultyFileError(InputError):
    """Raised with all faults of one file, one sentence each."""

    def __init__(self, sentences: Iterable[str]):
        self.sentences = tuple(sentences)
        super().__init__("\n".join(self.sentences))


def input_error(subject: object, found: str, expected: str, remedy: str) -> InputError:
    """Return the error `subject: found; expected ...; remedy.`"""
    return InputError(f"{subject}: {found}; expected {expected}; {remedy}.")


def nearest(name: str, known: Iterable[str]) -> str:
    """Return `did you mean 'x'?` if a known name is similar, else the list of known names."""
    known = sorted(known)
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    return f"did you mean '{close[0]}'?" if close else f"known: {', '.join(known) or 'none'}"
