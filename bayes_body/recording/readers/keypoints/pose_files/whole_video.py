"""JSON of a whole video: AlphaPose's results (also COCO's), and the predictions of MMPose's inferencer.

AlphaPose writes a list of people, each with `image_id`, whose last number is the frame's, and `keypoints`, x, y, confidence of each in a row. MMPose
writes `instance_info`, a list of frames, each with `frame_id` and `instances` of `keypoints` (x, y) and `keypoint_scores`; `meta_info` may name the
keypoints. Frames of AlphaPose are counted from 0, those of MMPose as the file numbers them.
"""

import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import input_error
from bayes_body.base.files.read import parse_json, read_text
from bayes_body.recording.readers.keypoints.pose_files.names import keypoint_names
from bayes_body.recording.readers.keypoints.pose_files.pose_track import MOST_FRAMES, PoseTrack, largest_confidence, people_of

ALPHAPOSE, MMPOSE = "AlphaPose", "MMPose"
KIND = "AlphaPose's or MMPose's keypoints of a whole video"
LARGEST_BYTES = 2_000_000_000
LAST_NUMBER = re.compile(r"(\d+)\D*$")
AGAIN = "write it again"

type Row = Float[np.ndarray, "keypoint 3"]


def program_of(path: Path) -> str | None:
    """Return the program that wrote a JSON file of a whole video; None for another file."""
    try:
        with path.open("rb") as file:
            head = file.read(65536).decode("utf-8", "replace")
    except OSError:
        return None
    if '"instance_info"' in head or '"meta_info"' in head:
        return MMPOSE
    return ALPHAPOSE if head.lstrip().startswith("[") and '"keypoints"' in head else None


def read_whole_video(path: Path) -> PoseTrack:
    """Return the people of all frames of a file.

    Raises:
        InputError: no file, not JSON, or no such keypoints.
    """
    content = parse_json(read_text(path, KIND, LARGEST_BYTES), path, KIND)
    if isinstance(content, list):
        return _gathered(path, ALPHAPOSE, _of_alphapose(path, content), None)
    if isinstance(content, dict) and isinstance(content.get("instance_info"), list):
        return _gathered(path, MMPOSE, _of_mmpose(path, content["instance_info"]), _names(content.get("meta_info")))
    raise input_error(path, "neither a list of people nor `instance_info`", KIND, "name the file that the program wrote")


def _gathered(path: Path, program: str, rows: Iterator[tuple[int, Row]], names: tuple[str, ...] | None) -> PoseTrack:
    by_frame: dict[int, list[Row]] = defaultdict(list)
    for frame, row in rows:
        by_frame[frame].append(row)
    every = [row for group in by_frame.values() for row in group]
    counts = sorted({len(row) for row in every})
    if len(counts) > 1:
        raise input_error(path, f"people with {counts[0]} and with {counts[-1]} keypoints", "the same number for each", "use one network")
    names = names if names and counts and len(names) == counts[0] else None
    return PoseTrack(program, {frame: people_of(group) for frame, group in sorted(by_frame.items())}, names, largest_confidence(every))


def _of_alphapose(path: Path, people: Sequence[Any]) -> Iterator[tuple[int, Row]]:
    for number, person in enumerate(people, 1):
        entry = f"{path}: person {number}"
        if not isinstance(person, dict):
            raise input_error(entry, "no table", "image_id and keypoints", AGAIN)
        yield _frame(entry, "image_id", person.get("image_id")), _row(entry, _numbers(entry, person.get("keypoints")))


def _of_mmpose(path: Path, frames: Sequence[Any]) -> Iterator[tuple[int, Row]]:
    for number, frame in enumerate(frames, 1):
        entry = f"{path}: frame {number} of the list"
        instances = frame.get("instances") if isinstance(frame, dict) else None
        if not isinstance(instances, list):
            raise input_error(entry, "no list `instances`", "frame_id and instances", AGAIN)
        index = _frame(entry, "frame_id", frame.get("frame_id"))
        for instance in instances:
            places = _numbers(entry, instance.get("keypoints") if isinstance(instance, dict) else None)
            scores = _numbers(entry, instance.get("keypoint_scores"))
            if places.size != 2 * scores.size:
                raise input_error(entry, f"{places.size} coordinates and {scores.size} scores", "two coordinates for each score", AGAIN)
            yield index, np.column_stack([places.reshape(-1, 2), scores.ravel()])


def _frame(entry: str, key: str, value: Any) -> int:
    match = LAST_NUMBER.search(str(value)) if isinstance(value, int | str) and not isinstance(value, bool) else None
    if match is None or int(match[1]) > MOST_FRAMES:
        raise input_error(f"{entry}: {key}", f"{str(value)[:40]!r}", "a name that ends in the frame's number", AGAIN)
    return int(match[1])


def _numbers(entry: str, values: Any) -> Float[np.ndarray, "..."]:
    try:
        # Null becomes NaN, which is a keypoint that is not seen.
        numbers = np.array(values, float)
    except (TypeError, ValueError):
        numbers = np.zeros(0)
    if not numbers.size:
        raise input_error(f"{entry}: keypoints", "missing, or no numbers", "x, y and confidence of each", AGAIN)
    return numbers


def _row(entry: str, numbers: Float[np.ndarray, "..."]) -> Row:
    if numbers.size % 3:
        raise input_error(f"{entry}: keypoints", f"{numbers.size} numbers", "x, y, confidence of each keypoint in a row", AGAIN)
    return numbers.reshape(-1, 3)


def _names(meta: Any) -> tuple[str, ...] | None:
    """Return the names of the keypoints that MMPose states: a list, or a table by number."""
    names = meta.get("keypoint_id2name") if isinstance(meta, Mapping) else None
    if isinstance(names, Mapping) and all(str(place) in names for place in range(len(names))):
        names = [names[str(place)] for place in range(len(names))]
    return keypoint_names([str(name) for name in names]) if isinstance(names, list) else None
