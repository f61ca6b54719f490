"""The people of a recording as sessions: `bayes-body people` makes them, `bayes-body track --person` tracks them."""

from collections.abc import Callable
from pathlib import Path
from typing import Literal

from bayes_body.base.errors import input_error

ALL = "all"
type Show = Callable[[str], None]
type Person = int | Literal["all"]


def person_of(text: str) -> Person:
    """Return the person that an option names.

    Raises:
        InputError: neither a number from 1 up nor `all`.
    """
    if text == ALL:
        return "all"
    if not (text.isascii() and text.isdecimal()) or not 0 < int(text) < 10**6:
        raise input_error("--person", f"'{text}'", f"the number of a person, from 1 up, or {ALL}", "`bayes-body people SESSION` lists them")
    return int(text)


def people_sessions(recording: Path, person: Person, show: Show, bar: bool) -> list[Path]:
    """Return the sessions of the people of a recording that are asked for; they are made if the recording has none.

    Args:
        recording: the folder of the recording's session.
        person: the number of one, or all.
        show: receives lines for the user.
        bar: whether to show the progress on standard error.

    Raises:
        InputError: no such session, nobody in its keypoints, or no such person.
    """
    folders = made_sessions(recording) or _make(recording, show, bar)
    if person == ALL:
        return folders
    if person > len(folders):
        problem = f"{person}, but {recording} has {len(folders)} {'person' if len(folders) == 1 else 'people'}"
        raise input_error("--person", problem, f"1 to {len(folders)}", f"look at them with `bayes-body people {recording}`")
    return [folders[person - 1]]
