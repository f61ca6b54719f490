"""A picture of every person of a recording: the keypoints of the person in all cameras, and those of the others, in the frame that shows most."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from cv2.typing import MatLike
from jaxtyping import Float

from bayes_body.recording.readers.people.people import Person
from bayes_body.recording.readers.people.record import Crowd
from bayes_body.recording.session.session import Session
from bayes_body.view.overlay import backdrop, label, write_png
from bayes_body.view.windows import STILL_HEIGHT, grid

PICTURE = "picture.png"
# BGR: the person, and everybody else.
PERSON, OTHERS = (0, 140, 255), (170, 170, 170)
# Pairs of keypoints that lines join, by the ends of their names.
LINES = (
    *(("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "shoulder"), ("ankle", "heel"), ("ankle", "big_toe")),
)


def draw_people(session: Session, crowd: Crowd, folders: Sequence[Path]) -> None:
    """Write a picture into everybody's folder.

    Args:
        session: the recording.
        crowd: its people.
        folders: of their sessions, by number.

    Raises:
        InputError: an image cannot be read, or a picture cannot be written.
    """
    for person, folder in zip(crowd.persons, folders, strict=True):
        row = int((person.places >= 0).sum(axis=1).argmax())
        tiles = [_tile(session, crowd, person, row, c) for c in range(len(crowd.views))]
        write_png(folder / PICTURE, grid(tiles))


def _tile(session: Session, crowd: Crowd, person: Person, row: int, c: int) -> MatLike:
    """Return a camera's image with all detections, those of the person in colour."""
    frame, view, place = person.first + row, crowd.views[c], int(person.places[row, c])
    picture, note = backdrop(session, frame, view)
    picture = picture.copy()
    thick = max(2, round(max(picture.shape) / 400))
    for index, points in enumerate(crowd.people[frame][c]):
        is_person = index == place
        _draw(picture, points, crowd.names, PERSON if is_person else OTHERS, thick if is_person else max(1, thick // 2))
    scale = STILL_HEIGHT / picture.shape[0]
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    text = f"{view.camera.name}, frame {session.frame_number(frame)}{note}\n" + (f"person {person.number}" if place >= 0 else "not seen here")
    return label(small, text)


def _draw(picture: MatLike, points: Float[np.ndarray, "keypoint 3"], names: Sequence[str], colour: tuple[int, int, int], thick: int) -> None:
    places = {name: point[:2] for name, point in zip(names, points, strict=True) if np.isfinite(point[:2]).all()}
    pairs = [(f"{side}_{start}", f"{side}_{end}") for start, end in LINES for side in "lr"] + [("l_hip", "r_hip"), ("l_shoulder", "r_shoulder")]
    for start, end in pairs:
        if start in places and end in places:
            cv2.line(picture, _pixel(places[start]), _pixel(places[end]), colour, thick, cv2.LINE_AA)
    for point in places.values():
        cv2.circle(picture, _pixel(point), thick, colour, cv2.FILLED, cv2.LINE_AA)


def _pixel(point: Float[np.ndarray, "2"]) -> tuple[int, int]:
    return round(float(point[0])), round(float(point[1]))
