"""Tables of keypoints: DeepLabCut's csv, of one animal or of several, and SLEAP's analysis csv and h5.

DeepLabCut's csv has header rows `scorer`, perhaps `individuals`, `bodyparts` and `coords` (x, y, likelihood), and a row for each frame, whose first
column is its number. Its h5 is a table of pandas with a pickled header, and is not read. SLEAP's csv has a row for each person and frame: `track`,
`frame_idx`, `instance.score`, and `NAME.x`, `NAME.y`, `NAME.score`. Its h5 has `tracks` (track, 2, node, frame), `point_scores` and
`node_names`.
"""

import csv
import io
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import InputError, input_error
from bayes_body.base.files.read import read_text
from bayes_body.recording.readers.keypoints.pose_files.names import keypoint_names
from bayes_body.recording.readers.keypoints.pose_files.pose_track import MOST_FRAMES, PoseTrack, largest_confidence, people_of

DEEPLABCUT, SLEAP = "DeepLabCut", "SLEAP"
KIND = "a table of keypoints that DeepLabCut or SLEAP wrote"
LARGEST_BYTES = 2_000_000_000
AXES, SCORES = ("x", "y"), ("likelihood", "score")
FRAME = "frame_idx"

type Row = Float[np.ndarray, "keypoint 3"]


def program_of(path: Path) -> str | None:
    """Return the program that wrote a table; None for another file."""
    if path.suffix.lower() in (".h5", ".hdf5"):
        return _program_of_h5(path)
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            line = file.readline(65536)
    except OSError:
        return None
    head = line.strip().split(",")
    return DEEPLABCUT if head[0] == "scorer" else SLEAP if FRAME in head else None


def read_table(path: Path) -> PoseTrack:
    """Return the people of all frames of a table.

    Raises:
        InputError: no file, or no such table.
    """
    if path.suffix.lower() in (".h5", ".hdf5"):
        if _program_of_h5(path) == DEEPLABCUT:
            raise _refuse_deeplabcut_h5(path)
        return _of_sleap_h5(path)
    rows = list(csv.reader(io.StringIO(read_text(path, KIND, LARGEST_BYTES))))
    if rows and rows[0][:1] == ["scorer"]:
        return _of_deeplabcut(path, rows)
    if rows and FRAME in rows[0]:
        return _of_sleap(path, rows)
    raise input_error(path, "neither DeepLabCut's header nor SLEAP's", KIND, "name the file that the program wrote")


def _track(program: str, names: Sequence[str], rows: Iterator[tuple[int, Row]]) -> PoseTrack:
    by_frame: dict[int, list[Row]] = defaultdict(list)
    for frame, row in rows:
        people = by_frame[frame]
        # A row of a table is an animal that may not be in this frame.
        if np.isfinite(row[:, :2]).any():
            people.append(row)
    every = [row for group in by_frame.values() for row in group]
    people = {frame: people_of(group) for frame, group in sorted(by_frame.items())}
    return PoseTrack(program, people, keypoint_names(names), largest_confidence(every))


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float("nan")


def _index(path: Path, text: str, line: int) -> int:
    value = _number(text)
    if not (0 <= value <= MOST_FRAMES and value == int(value)):
        raise input_error(f"{path}: line {line}", f"'{text[:40]}'", "the number of a frame", "write the table again")
    return int(value)


# -- DeepLabCut -------------------------------------------------------------------------------------------------------------------------


def _of_deeplabcut(path: Path, rows: Sequence[Sequence[str]]) -> PoseTrack:
    heads = {row[0]: list(row) for row in rows[:4] if row and row[0] in ("scorer", "individuals", "bodyparts", "coords")}
    if not {"bodyparts", "coords"} <= heads.keys():
        raise input_error(path, "no rows `bodyparts` and `coords`", KIND, "name the file that the program wrote")
    parts, kinds = heads["bodyparts"], heads["coords"]
    animals = heads.get("individuals", [""] * len(parts))
    columns = [(animal, part, kind) for animal, part, kind in zip(animals, parts, kinds, strict=False)]
    return _of_columns(path, columns, [(line, row) for line, row in enumerate(rows[len(heads) :], len(heads) + 1) if row and row[0].strip()])


def _of_columns(path: Path, columns: Sequence[tuple[str, str, str]], rows: Sequence[tuple[int, Sequence[str]]]) -> PoseTrack:
    """Return the people of a table whose columns have an animal, a body part, and x, y or likelihood; the first one has the frame's number."""
    places = {column: place for place, column in enumerate(columns) if place and column[2] in (*AXES, *SCORES)}
    names = list(dict.fromkeys(part for _, part, _ in places))
    animals = list(dict.fromkeys(animal for animal, _, _ in places))

    def person(row: Sequence[str], animal: str) -> Row:
        def value(part: str, kind: str) -> float:
            place = places.get((animal, part, kind))
            return _number(row[place]) if place is not None and place < len(row) else float("nan")

        return np.array([[value(part, "x"), value(part, "y"), value(part, "likelihood")] for part in names])

    if not names:
        raise input_error(path, "no columns x and y", KIND, "name the file that the program wrote")
    return _track(DEEPLABCUT, names, ((_index(path, row[0], line), person(row, animal)) for line, row in rows for animal in animals))


def _refuse_deeplabcut_h5(path: Path) -> InputError:
    """The error for a table of pandas, whose columns are pickled: reading it would run what it holds."""
    problem, remedy = "DeepLabCut's table in HDF5, whose header is pickled", "write it with save_as_csv, or convert it with DeepLabCut"
    return input_error(path, problem, "its csv", remedy)


# -- SLEAP ------------------------------------------------------------------------------------------------------------------------------


def _of_sleap(path: Path, rows: Sequence[Sequence[str]]) -> PoseTrack:
    head = rows[0]
    names = list(dict.fromkeys(column.rpartition(".")[0] for column in head if column.endswith(".x")))
    places = {column: place for place, column in enumerate(head)}
    if not names or any(f"{name}.y" not in places for name in names):
        raise input_error(path, "no columns NAME.x and NAME.y", KIND, "export the analysis again")

    def value(row: Sequence[str], column: str, default: float) -> float:
        place = places.get(column)
        return _number(row[place]) if place is not None and place < len(row) else default

    def person(row: Sequence[str]) -> Row:
        # Without a score a place is a label that somebody set.
        return np.array([[value(row, f"{name}.x", np.nan), value(row, f"{name}.y", np.nan), value(row, f"{name}.score", 1.0)] for name in names])

    filled = ((line, row) for line, row in enumerate(rows[1:], 2) if row)
    return _track(SLEAP, names, ((_index(path, row[places[FRAME]], line), person(row)) for line, row in filled))


def _program_of_h5(path: Path) -> str | None:
    import h5py

    try:
        with h5py.File(path) as file:
            if {"tracks", "node_names"} <= file.keys():
                return SLEAP
            return DEEPLABCUT if any(isinstance(group, h5py.Group) and "table" in group for group in file.values()) else None
    except OSError:
        return None


def _of_sleap_h5(path: Path) -> PoseTrack:
    import h5py

    try:
        with h5py.File(path) as file:
            tracks = np.asarray(file["tracks"], float)
            names = [name.decode() if isinstance(name, bytes) else str(name) for name in np.asarray(file["node_names"]).ravel()]
            scores = np.asarray(file["point_scores"], float) if "point_scores" in file else np.ones((len(tracks), *tracks.shape[2:]))
    except (OSError, KeyError, ValueError, TypeError, UnicodeDecodeError) as error:
        raise input_error(path, f"cannot be read ({str(error)[:80]})", KIND, "export the analysis again") from None
    if tracks.ndim != 4 or tracks.shape[1] != 2 or tracks.shape[2] != len(names) or scores.shape != (len(tracks), *tracks.shape[2:]):
        raise _shapes(path, tracks, scores)
    people = np.concatenate([tracks.transpose(3, 0, 2, 1), scores.transpose(2, 0, 1)[..., None]], axis=-1)
    return _track(SLEAP, names, ((frame, row) for frame, group in enumerate(people) for row in group))


def _shapes(path: Path, tracks: np.ndarray, scores: np.ndarray) -> InputError:
    problem = f"tracks of shape {tracks.shape} and scores of shape {scores.shape}"
    return input_error(path, problem, "tracks (track, 2, node, frame) and scores (track, node, frame)", "export the analysis again")
