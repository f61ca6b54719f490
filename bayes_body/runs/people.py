"""The people of a recording as sessions: `bayes-body people` makes them, `bayes-body track --person` tracks them."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from bayes_body.base.errors import input_error

if TYPE_CHECKING:
    from bayes_body.recording.readers.people.record import Crowd
    from bayes_body.recording.session.session import Session

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
        InputError: no such session, at most one person in its keypoints, or no such person.
    """
    from bayes_body.recording.readers.people.record import made_sessions

    recording = recording if recording.is_dir() else recording.parent
    folders = made_sessions(recording) or make_people(recording, show, bar)
    if person == ALL:
        return folders
    if person > len(folders):
        problem = f"{person}, but {recording} has {len(folders)} {'person' if len(folders) == 1 else 'people'}"
        expected = f"1 to {len(folders)}" if len(folders) > 1 else "1"
        raise input_error("--person", problem, expected, f"look at them with `bayes-body people {recording}`")
    return [folders[person - 1]]


def make_people(recording: Path, show: Show, bar: bool) -> list[Path]:
    """Make the sessions of all people of a recording, each with a picture; show who they are, and return their folders.

    Raises:
        InputError: no such session, at most one person in its keypoints, or nobody whom two cameras agree on.
    """
    from bayes_body.recording.readers.people.people import describe_people
    from bayes_body.recording.readers.people.record import read_crowd, write_people
    from bayes_body.recording.readers.people.tracks import MOST_PEOPLE
    from bayes_body.recording.session.read import load_session
    from bayes_body.view.people_pictures import draw_people

    session = load_session(recording)
    crowd = read_crowd(session, bar)
    if not crowd.persons:
        problem = "cameras agree on nobody in its keypoints" if len(crowd.views) > 1 else "nobody is detected in several frames"
        raise input_error(recording, problem, "a person who is seen in eight frames at least", "check the calibration and the offsets of the cameras")
    for sentence in describe_people(crowd.persons, len(crowd.views), session.frame_number, crowd.most, MOST_PEOPLE):
        show(f"note: {sentence}")
    folders, remarks = write_people(session, crowd)
    for remark in remarks:
        show(f"note: {remark}")
    for line in table_of(session, crowd):
        show(line)
    draw_people(session, crowd, folders)
    return folders


def table_of(session: "Session", crowd: "Crowd") -> list[str]:
    """Return a table of the people of a session as lines: frames, cameras, pictures, stature, and how well cameras agree."""
    from bayes_body.recording.readers.keypoints.stature import measure_stature

    lines = [f"{'person':<7} {'frames':>15} {'cameras':>8} {'pictures':>9} {'stature':>8} {'misfit':>7}"]
    for person in crowd.persons:
        frames = f"{session.frame_number(person.first)} to {session.frame_number(person.last)}"
        cameras = int((person.places >= 0).any(axis=0).sum())
        stature = measure_stature(person.bodies, crowd.names) if person.bodies.shape[-1] == 3 else None
        height = "-" if stature is None else f"{stature.stature_m:.2f} m"
        lines.append(f"{person.number:<7} {frames:>15} {cameras:>8} {person.pictures:>9} {height:>8} {person.misfit:>7.1%}")
    return lines
