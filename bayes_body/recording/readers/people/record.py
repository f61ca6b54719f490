"""The people of a session: who they are, and a session for everyone."""

from pathlib import Path
from typing import NamedTuple

from bayes_body.base.errors import input_error
from bayes_body.base.progress import watched
from bayes_body.recording.readers.keypoints.person import People
from bayes_body.recording.readers.people.detections import has_detections, read_detections
from bayes_body.recording.readers.people.files import person_folder, set_aside, write_person
from bayes_body.recording.readers.people.people import Person, people_of
from bayes_body.recording.readers.people.presence import write_presences
from bayes_body.recording.readers.people.tracks import limited
from bayes_body.recording.session.people_folders import FOLDER, people_numbers
from bayes_body.recording.session.read import FILE_NAME
from bayes_body.recording.session.session import Session, View


class Crowd(NamedTuple):
    """Everybody in a session.

    Attributes:
        views: the cameras with keypoints.
        people: the detections of each frame and camera that were looked at.
        names: of the keypoints.
        persons: by number.
        most: the largest number of detections of a camera in a frame.
    """

    views: list[View]
    people: list[list[People]]
    names: tuple[str, ...]
    persons: list[Person]
    most: int


def read_crowd(session: Session, progress: bool = False) -> Crowd:
    """Return everybody in a session whose import kept all people.

    Raises:
        InputError: it has no detections, they cannot be read, or a camera moves.
    """
    if not has_detections(session):
        problem = "its keypoint files have at most one person in each picture, or it was imported without keypoints"
        remedy = "import it with the keypoints of all people; one person is tracked without --person"
        raise input_error(session.folder, problem, "detections of several people", remedy)
    check_still(session)
    views, people, names = read_detections(session)
    people, most = limited(people)
    persons = people_of([view.camera for view in views], people, session.fps, watched("following the people", progress))
    return Crowd(views, people, names, persons, most)


def check_still(session: Session) -> None:
    """Refuse a session with a moving camera.

    Raises:
        InputError: a camera moves.
    """
    if session.moves:
        raise input_error(session.folder, "a camera moves", "cameras that stand still, to tell people apart", "track the subject without --person")


def write_people(session: Session, crowd: Crowd) -> tuple[list[Path], list[str]]:
    """Write a session for everyone; return their folders, and remarks.

    Raises:
        InputError: the file system refuses it.
    """
    write_presences(session, crowd.persons)
    folders, remarks = list[Path](), list[str]()
    for person in crowd.persons:
        made, sentences = write_person(session, crowd.views, person, crowd.people, crowd.names)
        folders.append(made.folder)
        remarks += [f"person {person.number}: {sentence}" for sentence in sentences]
    # Earlier detections may have shown more people.
    for number in people_numbers(session.folder):
        if number > len(folders):
            remarks += [f"person {number}: {sentence}" for sentence in set_aside(person_folder(session, number))]
            (person_folder(session, number) / FILE_NAME).unlink(missing_ok=True)
    return folders, remarks


def made_sessions(folder: Path) -> list[Path]:
    """Return the folders of the people's sessions that exist, by number; none if the recording was imported again since."""
    made = [folder / FOLDER / f"person_{number}" for number in people_numbers(folder)]
    imported_s = (folder / FILE_NAME).stat().st_mtime if (folder / FILE_NAME).exists() else 0.0
    return made if all((path / FILE_NAME).stat().st_mtime >= imported_s for path in made) else []
