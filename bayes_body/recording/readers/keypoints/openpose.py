"""Read keypoints in OpenPose's format, and the layouts: the orders in which pose estimators list a body's keypoints.

OpenPose writes one JSON file per frame with `people`, each with `pose_keypoints_2d` = x, y, confidence of each keypoint. Pose2Sim and the converters
of MMPose and AlphaPose write the same. A keypoint that was not found is 0, 0, 0 in the file and NaN, NaN, 0 here.

The layouts have this project's names. BODY_25 and BODY_25B (OpenPose's released and experimental network) both have 25 keypoints, and a file does not
say which it holds. The wrong order gives a skeleton with implausible proportions (orders.py).
"""

import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from types import NoneType
from typing import Any

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import input_error
from bayes_body.base.files.read import parse_json, read_text
from bayes_body.base.progress import Watch, unwatched
from bayes_body.recording.readers.faults import Faults

KIND = "keypoints as OpenPose writes them, {people: [{pose_keypoints_2d: [x, y, confidence, ...]}]}"
# The last number of a file name: cam01.0007.json, walk_000000000007_keypoints.json.
NUMBER = re.compile(r"(\d+)(?:_keypoints)?\.json", re.IGNORECASE)
MOST_PEOPLE = 200
# A confidence above this is one in per cent.
PER_CENT = 20.0
MOST_KEYPOINTS = 500
# Far outside any image; a larger coordinate is damage.
FARTHEST_PX = 1e6
# A number above this does not fit a float.
TOO_LARGE = 1e300


@dataclass
class Tally:
    """What was strange in files, though they were read.

    Attributes:
        unplaced: number of keypoints with a confidence and without a place (NaN or null).
        largest: the largest confidence.
        missing, frames: number of frames that the files do not have, of so many.
        repeated: number of detections of a person who was detected already.
    """

    unplaced: int = 0
    largest: float = 0.0
    missing: int = 0
    frames: int = 0
    repeated: int = 0


def describe_tallies(tallies: Mapping[str, Tally]) -> list[str]:
    """Return a sentence for each kind of what was strange, with the cameras of which it is said."""
    sentences = []
    if missing := [f"{name} {tally.missing} of {tally.frames}" for name, tally in tallies.items() if tally.missing]:
        sentences.append(f"Frames that the keypoint files do not have: {', '.join(missing)}: the keypoints are missing there.")
    if repeated := [f"{name} {tally.repeated}" for name, tally in tallies.items() if tally.repeated]:
        sentences.append(f"Detections of a person who was detected in the same frame already are left out: {', '.join(repeated)}.")
    if unplaced := {name: tally.unplaced for name, tally in tallies.items() if tally.unplaced}:
        counts = ", ".join(f"{name} {count}" for name, count in unplaced.items())
        sentences.append(f"Keypoints with a confidence and no place (NaN or null) count as not found: {counts}.")
    if large := {name: tally.largest for name, tally in tallies.items() if tally.largest > 1}:
        largest = max(large.values())
        scale = "; they look like per cent: divide them by 100" if largest > PER_CENT else ""
        sentences.append(f"Confidences up to {largest:.3g} are cut to 1 ({', '.join(large)}){scale}.")
    return sentences


def read_people(path: Path, tally: Tally | None = None) -> Float[np.ndarray, "person keypoint 3"]:
    """The people of one file: column, row (pixels; NaN where not found) and confidence, from 0 to 1; (0, 0, 3) without people.

    Some networks give confidences above 1; they are clipped to 1. A coordinate that is NaN or null is not found, whatever the confidence.

    Args:
        path: the file.
        tally: counts what was strange.

    Raises:
        InputError: no file, not JSON, or no such keypoints.
    """
    people = _people(path)
    if not people:
        return np.zeros((0, 0, 3))
    rows = [_row(path, number, person) for number, person in enumerate(people, 1)]
    counts = sorted({len(row) for row in rows})
    if len(counts) > 1:
        raise input_error(path, f"people with {counts[0] // 3} and with {counts[-1] // 3} keypoints", "the same number for each", "restore the file")
    points = np.array(rows, float).reshape(len(rows), -1, 3)
    placed = np.isfinite(points[..., :2]).all(axis=-1)
    if (np.abs(points[placed][:, :2]) > FARTHEST_PX).any():
        raise input_error(path, "a keypoint far outside any image", "pixels", "restore the file")
    confidence = np.where(np.isnan(points[..., 2]), 0.0, points[..., 2])
    if tally is not None:
        tally.unplaced += int((~placed & (confidence > 0)).sum())
        tally.largest = max(tally.largest, float(confidence.max(initial=0.0)))
    points[..., 2] = np.where(placed, np.clip(confidence, 0.0, 1.0), 0.0)
    points[..., :2][points[..., 2] == 0] = np.nan
    return points


def _people(path: Path) -> list[Any]:
    content = parse_json(read_text(path, KIND), path, KIND)
    people = content.get("people") if isinstance(content, dict) else None
    if not isinstance(people, list) or len(people) > MOST_PEOPLE:
        problem = "no list `people`" if not isinstance(people, list) else f"{len(people)} people"
        raise input_error(path, problem, f"{KIND}, at most {MOST_PEOPLE} people", "restore the file")
    return people


def _row(path: Path, number: int, person: Any) -> list[float]:
    numbers = person.get("pose_keypoints_2d") if isinstance(person, dict) else None
    if not isinstance(numbers, list) or not numbers or len(numbers) % 3 or len(numbers) > 3 * MOST_KEYPOINTS:
        problem = f"{len(numbers)} numbers" if isinstance(numbers, list) else "none"
        raise input_error(f"{path}: person {number}: pose_keypoints_2d", problem, "x, y, confidence of each keypoint in a row", "restore the file")
    # This excludes true and false.
    kinds = set(map(type, numbers))
    values = [math.nan if value is None else value for value in numbers] if NoneType in kinds else numbers
    if not kinds <= {int, float, NoneType} or any(map(TOO_LARGE.__lt__, map(abs, values))):
        raise input_error(f"{path}: person {number}: pose_keypoints_2d", "an entry that is not a number", "numbers", "restore the file")
    return list(map(float, values))


def keypoint_files(folder: Path) -> dict[int, Path]:
    """The files of a folder by frame number, sorted.

    Raises:
        InputError: no such folder, no numbered json files in it, or two files with the same number.
    """
    # Names, not paths: a long recording has tens of thousands.
    names = sorted(name for name in os.listdir(folder) if name.lower().endswith(".json")) if folder.is_dir() else []  # noqa: PTH208
    numbered = [(int(match[1][:18]), folder / name) for name in names if (match := NUMBER.search(name))]
    if not numbered:
        raise input_error(folder, "no numbered json files in it", "one file per frame, such as cam01.0000.json", "name the folder that holds them")
    files = dict(sorted(numbered, key=itemgetter(0)))
    if len(files) < len(numbered):
        raise input_error(
            folder, f"{len(numbered)} files with {len(files)} different numbers", "one file per frame", "keep the files of only one recording in it"
        )
    return files


def read_openpose(
    folder: Path, frames: Sequence[int], tally: Tally | None = None, watch: Watch = unwatched
) -> Float[np.ndarray, "frame person keypoint 3"]:
    """The keypoints of one camera, frame by frame: column, row (pixels) and confidence, from 0 to 1.

    Args:
        folder: one file per frame, with the frame number at the end of its name.
        frames: the numbers of the frames to read.
        tally: counts what was strange.
        watch: shows how many frames are read.

    Returns:
        The person axis is as long as the fullest frame needs. A missing person, like a keypoint that was not found, is NaN, NaN, 0. People keep the
        order of their file; the same index need not be the same person.

    Raises:
        FaultyFileError: one sentence for each file that is missing or cannot be used.
        InputError: no folder with such files, or frames with different numbers of keypoints.
    """
    files = keypoint_files(folder)
    missing = [number for number in frames if number not in files]
    if missing:
        problem = f"{len(missing)} of {len(frames)} frames have no file, the first is {missing[0]}"
        raise input_error(folder, problem, f"a file for each frame; there are {min(files)} to {max(files)}", "restore them, or read other frames")
    faults, people = Faults(), []
    for number in watch(frames):
        with faults.collect():
            people.append(read_people(files[number], tally))
    faults.raise_any()
    counts = sorted({group.shape[1] for group in people if len(group)})
    if len(counts) > 1:
        raise input_error(
            folder,
            f"frames with {counts[0]} and with {counts[-1]} keypoints per person",
            "the same number in each",
            "keep only one series of files in it",
        )
    series = np.full((len(people), max(map(len, people), default=0), counts[0] if counts else 0, 3), np.nan)
    series[..., 2] = 0.0
    for frame, group in zip(series, people, strict=True):
        if len(group):
            frame[: len(group)] = group
    return series


_COCO = (
    *("nose", "l_eye", "r_eye", "l_ear", "r_ear", "l_shoulder", "r_shoulder", "l_elbow", "r_elbow", "l_wrist", "r_wrist"),
    *("l_hip", "r_hip", "l_knee", "r_knee", "l_ankle", "r_ankle"),
)
_OPENPOSE_ARMS = ("nose", "neck", "r_shoulder", "r_elbow", "r_wrist", "l_shoulder", "l_elbow", "l_wrist")
_OPENPOSE_LEGS = ("r_hip", "r_knee", "r_ankle", "l_hip", "l_knee", "l_ankle")
_OPENPOSE_FACE = ("r_eye", "l_eye", "r_ear", "l_ear")
_OPENPOSE_FEET = ("l_big_toe", "l_small_toe", "l_heel", "r_big_toe", "r_small_toe", "r_heel")
# `head` is the crown; `neck` is the point between the shoulders (BODY_25, COCO_18, HALPE_26); `upper_neck` is just below the skull.
LAYOUTS: dict[str, tuple[str, ...]] = {
    "COCO_17": _COCO,
    "COCO_18": (*_OPENPOSE_ARMS, *_OPENPOSE_LEGS, *_OPENPOSE_FACE),
    "BODY_25": (*_OPENPOSE_ARMS, "mid_hip", *_OPENPOSE_LEGS, *_OPENPOSE_FACE, *_OPENPOSE_FEET),
    "BODY_25B": (*_COCO, "upper_neck", "head", *_OPENPOSE_FEET),
    "COCO_133": (
        *(*_COCO, *_OPENPOSE_FEET),
        *(f"face_{number}" for number in range(1, 69)),
        *(f"{side}_hand_{number}" for side in "lr" for number in range(1, 22)),
    ),
    "HALPE_26": (*_COCO, "head", "neck", "mid_hip", "l_big_toe", "r_big_toe", "l_small_toe", "r_small_toe", "l_heel", "r_heel"),
}
