"""Types of command-line arguments, for the programs that users copy; argparse prints the sentences that these raise."""

import argparse
import json
from collections.abc import Callable
from typing import Any


def whole_number(least: int, most: int = 2**32 - 1) -> Callable[[str], int]:
    """Return a function that reads whole numbers from `least` to `most`.

    Raises:
        argparse.ArgumentTypeError: by the returned function, for any other text.
    """

    def read(text: str) -> int:
        if not (text.isdecimal() and least <= int(text) <= most):
            raise argparse.ArgumentTypeError(f"{text}; expected a whole number from {least} to {most}; give another number")
        return int(text)

    return read


def setting(text: str) -> tuple[str, Any]:
    """Return the name and the value in a text such as `step=0.1` or `carry="means"`.

    Raises:
        argparse.ArgumentTypeError: the text does not have this form.
    """
    name, _, value = text.partition("=")
    try:
        return name, json.loads(value)
    except ValueError:
        raise argparse.ArgumentTypeError(f'{text}; expected NAME=VALUE; write for example step=0.1 or carry="means"') from None
