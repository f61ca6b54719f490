"""Collect the errors of many files, so that a user reads all of them at once."""

from collections.abc import Iterator
from contextlib import contextmanager

from bayes_body.base.errors import FaultyFileError, InputError


class Faults:
    """Collects the sentences of every InputError raised inside `with faults.collect():`."""

    def __init__(self) -> None:
        self.sentences: list[str] = []

    @contextmanager
    def collect(self) -> Iterator[None]:
        """Catch an InputError, keep its sentences, and go on after the block."""
        try:
            yield
        except FaultyFileError as error:
            self.sentences += error.sentences
        except InputError as error:
            self.sentences.append(str(error))

    def raise_any(self) -> None:
        """Raise one error for everything that was collected.

        Raises:
            FaultyFileError: something was collected.
        """
        if self.sentences:
            raise FaultyFileError(self.sentences)


def unnoted(sentence: str) -> None:
    """Drop a sentence for the user: the default of readers that tell what they left out."""
    del sentence
