"""One camera's folder of keypoint files, to which a pose estimator adds a file for each frame.

A poll looks for the file of one number, whose name is known: the numbers of a folder go on in one pattern. The whole folder is listed only now and
then, since a long recording has many files. The list finds names of another pattern.
"""

import time
from pathlib import Path

from bayes_body.base.errors import InputError
from bayes_body.base.files.read import parse_json, read_text
from bayes_body.recording.readers.keypoints.openpose import KIND, NUMBER, keypoint_files, read_people
from bayes_body.recording.readers.keypoints.person import People

# Seconds between two lists of a folder.
LIST_S = 0.25


class ArrivingFolder:
    """The files of a folder by number.

    Args:
        folder: it has at least one file.

    Attributes:
        first: the number of its first file.

    Raises:
        InputError: no such folder, no numbered json files in it, or two files with the same number.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        self._list()
        self.first = min(self._files)

    def find(self, number: int) -> Path | None:
        """The file of a number; None if there is none.

        Raises:
            InputError: the folder is gone, or two of its files have the same number.
        """
        if number not in self._files and (expected := self._expected(number)).exists():
            self._files[number] = expected
        elif number not in self._files and time.monotonic() - self._listed_s > LIST_S:
            self._list()
        return self._files.get(number)

    def is_past(self, number: int) -> bool:
        """Whether the folder has the next file, or a later one in its last list."""
        return self._latest > number or self._expected(number + 1).exists()

    def _list(self) -> None:
        self._files = keypoint_files(self.folder)
        self._latest = max(self._files)
        self._listed_s = time.monotonic()

    def _expected(self, number: int) -> Path:
        """The path of a number by the pattern of the latest file in the list."""
        name = self._files[self._latest].name
        match = NUMBER.search(name)
        start, end = match.span(1) if match else (0, 0)
        return self.folder / f"{name[:start]}{number:0{end - start}d}{name[end:]}"


def read_complete(path: Path) -> People | None:
    """The people of a file; None while it is not complete, because another program is writing it.

    Raises:
        InputError: it is complete, and has no keypoints as OpenPose writes them.
    """
    try:
        return read_people(path)
    except InputError:
        # It may have become complete in the meantime: only a second look tells whether a complete file is wrong.
        return read_people(path) if _is_complete(path) else None


def _is_complete(path: Path) -> bool:
    try:
        parse_json(read_text(path, KIND), path, KIND)
    except InputError:
        return False
    return True
