"""Pictures of several people of one recording: each person in a colour, with the name near the head, all cameras side by side.

The bodies have the colours of the people, so the pictures do not show the sides of the bodies; those of a single run do (view/overlay.py).
"""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from cv2.typing import MatLike
from jaxtyping import Float

from bayes_body.base.files.atomic import make_folder, remove_partial, replacing
from bayes_body.base.progress import Watch, unwatched
from bayes_body.model.build import Model
from bayes_body.results.metrics.fit import Outline, outlines, seen_in
from bayes_body.view.colours import bgr
from bayes_body.view.overlay import (
    FAN,
    FONT,
    drawable,
    frames_drawn,
    label,
    paint,
    run_backdrop,
    still_paths,
    text_scale,
    write_png,
    write_text,
)
from bayes_body.view.people import People, Person, PersonPose
from bayes_body.view.video import h264_video
from bayes_body.view.windows import EMPTY, STILL_HEIGHT, Window, body_boxes, grid, windows_around

NOBODY = "\nnobody is tracked here"
# Pixels of a tile between a name and the head below it, and between two names. Share of the height of a body
# without a head, above which the name is.
ABOVE_HEAD, ROOM, UPPERMOST = 8, 4, 0.1


class Rectangle(NamedTuple):
    """A rectangle of a picture, pixels."""

    first_column: int
    top: int
    right: int
    bottom: int

    def overlaps(self, rectangle: "Rectangle") -> bool:
        """Return whether the two have pixels in common."""
        is_beside = self.right <= rectangle.first_column or rectangle.right <= self.first_column
        return not (is_beside or self.bottom <= rectangle.top or rectangle.bottom <= self.top)


def draw_people(people: People, path: Path, watch: Watch = unwatched) -> list[Path]:
    """Write a video of all people, and up to five evenly spaced stills `frame_NNNNNN.png` in the folder beside it with the video's name.

    The video has the frames from the first in which anybody is there to the last, and runs at the recording's speed; of a long recording it has every
    second, third, ... of them. Return the files.

    Args:
        people: the people.
        path: the video's file, .mp4.
        watch: wraps the frames to show progress.

    Raises:
        InputError: a file cannot be written, or an image or a model cannot be used.
    """
    places = frames_drawn(len(people.frames))
    numbers = people.frames[:: places.step]
    stills = still_paths(make_folder(path.parent) / path.stem, numbers)
    remove_partial(make_folder(path.parent / path.stem))
    poses = {person.number: {pose.frame: pose for pose in person.poses(person.part_of(numbers), FAN)} for person in people.persons}
    windows = windows_around(people.session, _boxes(people, numbers, poses), numbers.step)
    large = [window.scaled(STILL_HEIGHT) for window in windows]
    with drawable(path), replacing(path) as partial, ExitStack() as video:
        write = None
        for place in watch(range(len(numbers))):
            number = numbers[place]
            picture = people_mosaic(people, number, poses, windows, place)
            write = write or video.enter_context(h264_video(partial, people.fps / numbers.step, (picture.shape[1], picture.shape[0])))
            write(picture)
            if number in stills:
                write_png(stills[number], people_mosaic(people, number, poses, large, place))
    return [path, *stills.values()]


def _boxes(people: People, numbers: range, poses: Mapping[int, Mapping[int, PersonPose]]) -> Float[np.ndarray, "frame camera 2 2"]:
    """Return the box around all who are there in each frame and image; NaN where there is nobody."""
    boxes = np.full((len(numbers), len(people.session.views), 2, 2), np.nan)
    for place, number in enumerate(numbers):
        for person, index in people.present(number):
            box = body_boxes(person.run.session, _model(person, index), poses[person.number][number].central.pose)
            boxes[place, :, 0] = np.fmin(boxes[place, :, 0], box[:, 0])
            boxes[place, :, 1] = np.fmax(boxes[place, :, 1], box[:, 1])
    return boxes


def _model(person: Person, index: int) -> Model:
    return seen_in(person.run.settled_model, person.run.session, index)


def people_mosaic(people: People, number: int, poses: Mapping[int, Mapping[int, PersonPose]], windows: Sequence[Window], place: int) -> MatLike:
    """Return the picture of one frame, all cameras in a grid.

    Args:
        people: the people.
        number: the number of the frame in the recording.
        poses: the poses of each person, by the person's number and the frame's.
        windows: one for each camera.
        place: the place of the frame among those of the windows.

    Raises:
        InputError: an image of the recording cannot be used.
    """
    present = list(people.present(number))
    bodies = []
    for person, index in present:
        pose, model = poses[person.number][number], _model(person, index)
        bodies.append((person, pose.central.is_mean, outlines(model, pose.central.pose), [outlines(model, draw) for draw in pose.draws]))
    tiles = []
    for c, (view, window) in enumerate(zip(people.session.views, windows, strict=True)):
        picture, note = _image(people, present, number, c)
        tile, names = window.cut(picture, place), []
        for person, is_mean, strong, fan in bodies:
            placed = [[Outline(part, window.place(polygon, place)) for part, polygon in body[c]] for body in (strong, *fan)]
            tile = paint(tile, placed[0], placed[1:], person.colour)
            names.append((person, f"{person.label}{'' if is_mean else ', medoid'}", placed[0]))
        _write_names(tile, names)
        tiles.append(label(tile, f"{view.camera.name}  frame {number}{note}"))
    return grid(tiles)


def _image(people: People, present: Sequence[tuple[Person, int]], number: int, camera: int) -> tuple[MatLike, str]:
    """Return a camera's image of a frame. Only images from which a run was made are shown, so there is none in a frame without anybody."""
    if present:
        person, index = present[0]
        return run_backdrop(person.run, index, camera)
    width, height = people.session.views[camera].camera.size_px
    return np.full((height, width, 3), EMPTY, np.uint8), NOBODY


def _write_names(tile: MatLike, names: Sequence[tuple[Person, str, list[Outline]]]) -> None:
    """Write each name above its body in the person's colour, inside of the tile, and in the nearest free line where another name is."""
    scale, boxes = text_scale(tile), list[Rectangle]()
    for person, text, body in names:
        if not _is_inside(tile, body):
            continue
        head = _head(body)
        (width, height), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, FONT * scale, round(2 * scale))
        lowest, line = tile.shape[0] - below - 2, height + below + ROOM
        column = int(np.clip(head[:, 0].mean() - width / 2, 2, max(2, tile.shape[1] - width - 2)))
        wanted = int(np.clip(head[:, 1].min() - ABOVE_HEAD * scale, height + 2, lowest))
        rows = [wanted + sign * shift * line for shift in range(len(names)) for sign in (-1, 1)]
        rectangles = {row: Rectangle(column, row - height, column + width, row + below) for row in rows if height < row <= lowest}
        free = (row for row, rectangle in rectangles.items() if not any(map(rectangle.overlaps, boxes)))
        row = next(free, wanted)
        boxes.append(rectangles.get(row, Rectangle(column, row - height, column + width, row + below)))
        write_text(tile, text, (column, row), bgr(person.colour), 2)


def _head(body: list[Outline]) -> Float[np.ndarray, "corner 2"]:
    """Return the outline of the head; of a body without one, the uppermost corners."""
    heads = [outline.polygon for outline in body if "head" in outline.part]
    if heads:
        return np.concatenate(heads)
    corners = np.concatenate([outline.polygon for outline in body])
    return corners[corners[:, 1] <= corners[:, 1].min() + UPPERMOST * np.ptp(corners[:, 1])]


def _is_inside(tile: MatLike, body: list[Outline]) -> bool:
    """Return whether a part of a body is inside of a tile."""
    size = tile.shape[1::-1]
    return any(((outline.polygon.max(axis=0) > 0) & (outline.polygon.min(axis=0) < size)).all() for outline in body)
