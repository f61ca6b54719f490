"""Who is in a recording, in short: `detections/people.json` beside the session. By it `track` says whom it tracks without following anybody again.

A list by the persons' numbers, each with `pictures`, in how many the person is seen, and `first` and `last`, the numbers of the frames.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from bayes_body.base.errors import InputError
from bayes_body.base.files.atomic import write_text
from bayes_body.base.files.read import read_text
from bayes_body.recording.readers.people.detections import FOLDER, PEOPLE_FILE
from bayes_body.recording.readers.people.people import CLOSE_REMARK, Person, is_close
from bayes_body.recording.session.people_folders import people_numbers
from bayes_body.recording.session.session import Session

LARGEST_BYTES = 1_000_000


class Presence(NamedTuple):
    """When a person is there.

    Attributes:
        pictures: in how many pictures the person is seen, all cameras together.
        first: the number of the first frame.
        last: the number of the last frame.
    """

    pictures: int
    first: int
    last: int


def write_presences(session: Session, persons: Sequence[Person]) -> None:
    """Write the file.

    Args:
        session: whose detections are written already.
        persons: by number.

    Raises:
        InputError: the file system refuses it.
    """
    rows = [Presence(person.pictures, session.frame_number(person.first), session.frame_number(person.last)) for person in persons]
    write_text(session.folder / FOLDER / PEOPLE_FILE, json.dumps([row._asdict() for row in rows]) + "\n")


def read_presences(folder: Path) -> list[Presence] | None:
    """Return who is in the recording of a session's folder, by number; None if nothing that can be read tells."""
    try:
        rows = json.loads(read_text(folder / FOLDER / PEOPLE_FILE, "who is in a recording", LARGEST_BYTES))
        return [Presence(*(int(row[name]) for name in Presence._fields)) for row in rows]
    except (InputError, ValueError, KeyError, TypeError, OverflowError, RecursionError):
        return None


def describe_default(session: Session) -> list[str]:
    """Return sentences on who is tracked if nobody is named, and who is there beside; none if there is nobody else."""
    presences, folder = read_presences(session.folder), session.folder
    hint = f"--person 2 tracks another one, --person all everybody; `bayes-body people {folder}` shows them."
    if presences is None:
        tracked = "Several people are in view: person 1 is tracked, who is seen by most cameras for the longest time."
        return [f"{tracked} {hint}"] if people_numbers(folder)[1:] else []
    if len(presences) < 2:
        return []
    first, second = presences[:2]
    cameras = sum(view.keypoints is not None for view in session.views)
    pictures = f"in {first.pictures} pictures of {cameras} camera{'s' * (cameras != 1)}"
    frames = f"frames {first.first} to {first.last}"
    reason = f"who is seen by most cameras for the longest time: {pictures}, {frames}, person 2 in {second.pictures}"
    tracked = f"There are {len(presences)} people. Person 1 is tracked, {reason}."
    return [f"{tracked} {hint}", *([CLOSE_REMARK] if is_close(first.pictures, second.pictures) else [])]
