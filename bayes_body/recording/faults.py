"""Collecting what is wrong with many files, so that a user reads all of it at once."""

from collections.abc import Iterator
from contextlib import contextmanager

from bayes_body.errors import FaultyFileError, InputError


class Faults:
    """The sentences of every InputError raised inside `with faults.collect():`."""

    def __init__(self) -> None:
        self.sentences: list[str] = []

    @contextmanager
    def collect(self) -> Iterator[None]:
        """Keep an InputError's sentences and go on after the block."""
        try:
            yield
        except FaultyFileError as error:
            self.sentences += error.sentences
        except InputError as error:
            self.sentences.append(str(error))

    def raise_any(self) -> None:
        """Report what was collected.

        Raises:
            FaultyFileError: anything was.
        """
        if self.sentences:
            raise FaultyFileError(self.sentences)
