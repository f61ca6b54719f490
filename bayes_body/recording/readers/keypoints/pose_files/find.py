"""Find the keypoints of each camera in a folder: a folder of OpenPose's files, or one file of a whole video."""

import re
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from bayes_body.base.errors import input_error
from bayes_body.recording.readers.file_names import composed
from bayes_body.recording.readers.keypoints.pose_files import tables, whole_video
from bayes_body.recording.readers.keypoints.pose_files.pose_track import PoseTrack

SUFFIXES = (".json", ".csv", ".h5", ".hdf5")
# A folder with more files has one for each frame.
MOST_FILES = 4


class PoseFiles(NamedTuple):
    """What a folder has.

    Attributes:
        paths: of each camera, the folder or the file; cameras without one are left out.
        unused: the other folders and files of keypoints in it.
    """

    paths: dict[str, Path]
    unused: list[Path]


def find_pose_files(folder: Path, cameras: Sequence[str]) -> PoseFiles:
    """Find the keypoints of each camera: a folder CAMERA_json or CAMERA, or a file whose name begins with the camera's.

    Raises:
        InputError: a camera has several files.
    """
    entries = sorted(folder.iterdir()) if folder.is_dir() else []
    paths = {}
    for name in cameras:
        folders = [entry for entry in entries if entry.is_dir() and composed(entry.name) in (composed(name), composed(f"{name}_json"))]
        files = [entry for entry in entries if entry.is_file() and _is_of(entry, name)]
        if folders:
            paths[name] = whole_file(folders[0]) or folders[0]
        elif len(files) > 1:
            names = ", ".join(path.name for path in files)
            raise input_error(folder, f"{names} for camera '{name}'", "one file of keypoints for each camera", "keep only one of them")
        elif files:
            paths[name] = files[0]
    used = {*paths.values(), *(path.parent for path in paths.values())}
    return PoseFiles(paths, [entry for entry in entries if entry not in used and (entry.is_dir() or entry.suffix.lower() in SUFFIXES)])


def _is_of(path: Path, camera: str) -> bool:
    """Whether a file has the camera's name, or begins with it: cam01.json, cam01DLC_resnet50.csv, cam01.analysis.h5."""
    return path.suffix.lower() in SUFFIXES and re.match(rf"{re.escape(composed(camera))}(?![0-9a-z])", composed(path.name)) is not None


def whole_file(folder: Path) -> Path | None:
    """Return the only file of a folder, if a program wrote it for a whole video."""
    programs = [path for path in _files(folder) if program_of(path) is not None]
    return programs[0] if len(programs) == 1 else None


def _files(folder: Path) -> Iterator[Path]:
    """Yield files that may hold a whole video."""
    paths = list(islice((path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and path.is_file()), MOST_FILES + 1))
    yield from sorted(paths) if len(paths) <= MOST_FILES else ()


def program_of(path: Path) -> str | None:
    """Return the program that wrote a file of a whole video; None for another file."""
    return whole_video.program_of(path) if path.suffix.lower() == ".json" else tables.program_of(path)


def read_track(path: Path) -> PoseTrack:
    """Return the people of all frames of a file of a whole video.

    Raises:
        InputError: no file, or not one that these programs write.
    """
    return whole_video.read_whole_video(path) if path.suffix.lower() == ".json" else tables.read_table(path)
