"""A person of a recording as a session of its own: SESSION/people/person_N, with that person's frames, keypoints and lengths."""

import hashlib
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bayes_body.base.files.atomic import refused, write_text
from bayes_body.recording.readers.excerpt import excerpt
from bayes_body.recording.readers.keypoints.candidates import Bystanders, Candidates
from bayes_body.recording.readers.keypoints.measured_lengths import with_measured_lengths
from bayes_body.recording.readers.keypoints.person import People
from bayes_body.recording.readers.keypoints.series import KeypointSeries, write_series
from bayes_body.recording.readers.people.people import Person
from bayes_body.recording.session.people_folders import FOLDER, PREFIX
from bayes_body.recording.session.read import FILE_NAME, save_session
from bayes_body.recording.session.session import CameraSpec, Keypoints, Session, Subject, View

KEYPOINTS = "keypoints"
# The digest of a person's session file as it was made, and the name of one that was edited since.
DIGEST_FILE, EDITED = ".session_digest", "session_edited"


def person_folder(session: Session, number: int) -> Path:
    """The folder of a person's session."""
    return session.folder / FOLDER / f"{PREFIX}{number}"


def series_of(person: Person, camera: CameraSpec, c: int, people: Sequence[Sequence[People]], names: tuple[str, ...], first: int) -> KeypointSeries:
    """Return a person's keypoints in a camera, with the candidates and the bystanders.

    Args:
        person: the person.
        camera: calibrated.
        c: its place among the cameras with keypoints.
        people: for each frame of the recording and camera.
        names: of the keypoints.
        first: the number of the person's first frame in the camera's numbering.
    """
    nobody = np.zeros((0, len(names), 3))
    frames = (people[person.first + row][c] for row in range(person.frames))
    groups = [_inside(camera, group) if len(group) else nobody for group in frames]
    shares = [frame[c] for frame in person.shares]
    unseen = np.full((len(names), 3), np.nan)
    points = np.array([unseen if place < 0 else group[place] for group, place in zip(groups, person.places[:, c].tolist(), strict=True)])
    strangers = [group[row < 0.5] for group, row in zip(groups, shares, strict=True)]
    bystanders = Bystanders(np.concatenate([nobody, *strangers]), np.array([len(group) for group in strangers]))
    return KeypointSeries(points, names, first, _candidates(groups, shares, len(names)), bystanders)


def _candidates(groups: Sequence[People], shares: Sequence[np.ndarray], keypoints: int) -> Candidates:
    orders = [np.argsort(-row, kind="stable")[: int((row > 0).sum())] for row in shares]
    most = max((len(order) for order in orders), default=0)
    points, chosen = np.full((len(groups), max(most, 1), keypoints, 3), np.nan), np.zeros((len(groups), max(most, 1)))
    for row, order in enumerate(orders):
        points[row, : len(order)], chosen[row, : len(order)] = groups[row][order], shares[row][order]
    return Candidates(points, chosen)


def _inside(camera: CameraSpec, group: People) -> People:
    """The detections with the keypoints inside the image only, as an imported subject has them."""
    is_outside = ~((group[..., :2] >= 0).all(axis=-1) & (group[..., :2] <= camera.size_px).all(axis=-1))
    return np.where(is_outside[..., None], [np.nan, np.nan, 0.0], group)


def in_all_frames(person: Person, people: Sequence[Sequence[People]]) -> Person:
    """Return the person with rows for all frames of the recording; in those before the first and after the last nobody is detected."""

    def absent(frames: Sequence[Sequence[People]]) -> list[list[np.ndarray]]:
        return [[np.zeros(len(group)) for group in frame] for frame in frames]

    leading, trailing = absent(people[: person.first]), absent(people[person.last + 1 :])
    places = np.pad(person.places, ((len(leading), len(trailing)), (0, 0)), constant_values=-1)
    bodies = np.pad(person.bodies, ((len(leading), len(trailing)), (0, 0), (0, 0)), constant_values=np.nan)
    return person._replace(first=0, last=len(people) - 1, places=places, shares=[*leading, *person.shares, *trailing], bodies=bodies)


def write_person(
    session: Session, views: Sequence[View], person: Person, people: Sequence[Sequence[People]], names: tuple[str, ...]
) -> tuple[Session, list[str]]:
    """Write the session of a person; return it, and remarks.

    Args:
        session: the recording's.
        views: its cameras with keypoints.
        person: the person.
        people: for each frame of the recording and camera.
        names: of the keypoints.

    Raises:
        InputError: the file system refuses it.
    """
    part = excerpt(session, session.frame_number(person.first), person.frames)
    folder = person_folder(session, person.number)
    files, first = {}, {}
    for c, view in enumerate(views):
        series = series_of(person, view.camera, c, people, names, part.number(view, 0))
        files[view.camera.name] = f"{KEYPOINTS}/{view.camera.name}.npz"
        write_series(folder / files[view.camera.name], series)
        first[view.camera.name] = _named(series.keypoints[0], names)
    person_session = replace(
        part,
        folder=folder,
        title=f"{session.title}, person {person.number}",
        views=tuple(replace(_from_folder(view, session.folder, folder), keypoints=files.get(view.camera.name)) for view in part.views),
        subject=session.subject if person.number == 1 else Subject(body=session.subject.body),
        initial={},
        initial_markers={},
        positions=frozenset(),
        initial_keypoints={name: points for name, points in first.items() if points},
        truth=_truth(session, person, folder),
        calibration=None if session.calibration is None else _moved(session.calibration, session.folder, folder),
    )
    person_session, remarks = with_measured_lengths(person_session)
    remarks += set_aside(folder)
    save_session(person_session)
    write_text(folder / DIGEST_FILE, _digest(folder))
    return person_session, remarks


def set_aside(folder: Path) -> list[str]:
    """Keep a person's session file that somebody has changed since it was made, under another name; return a sentence about it.

    Args:
        folder: of the person's session, which is about to be made anew or to end.

    Raises:
        InputError: the file system refuses it.
    """
    try:
        is_changed = (folder / DIGEST_FILE).read_bytes() != _digest(folder).encode()
    except OSError:
        return []
    if not is_changed:
        return []
    number, path = 1, folder / f"{EDITED}.toml"
    while path.exists():
        number += 1
        path = folder / f"{EDITED}_{number}.toml"
    try:
        (folder / FILE_NAME).rename(path)
    except OSError as error:
        raise refused(path, "written", error) from None
    return [f"its {FILE_NAME} was edited, and is made anew. The edited one is now {path}: repeat the changes that still hold."]


def _digest(folder: Path) -> str:
    return hashlib.sha256((folder / FILE_NAME).read_bytes()).hexdigest()


def _named(points: Float[np.ndarray, "keypoint 3"], names: Sequence[str]) -> Keypoints:
    rows = zip(names, points.tolist(), strict=True)
    return {name: (column, row, confidence) for name, (column, row, confidence) in rows if confidence > 0}


def _truth(session: Session, person: Person, folder: Path) -> str | None:
    """The recording's truth is that of its subject."""
    return None if session.truth is None or person.number > 1 or person.first else _moved(session.truth, session.folder, folder)


def _from_folder(view: View, source: Path, target: Path) -> View:
    """Return a view whose relative paths start at another folder."""
    names = ("images", "video", "masks", "background", "path")
    return replace(view, **{name: _moved(value, source, target) for name in names if (value := getattr(view, name)) is not None})


def _moved(path: str, source: Path, target: Path) -> str:
    return path if Path(path).is_absolute() else os.path.relpath(source / path, target)
