"""Digests of a recording: they tell whether images, videos and other files are still those from which a run was made.

Of each file the size is used, and of some evenly spaced files of a sequence, or pieces of a long file, the content.
"""

import hashlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bayes_body.base.errors import input_error
from bayes_body.recording.session.session import Session

# Number of sampled frames of a sequence, number of sampled pieces of a file, and their size in bytes.
FRAMES, PIECES, PIECE_BYTES = 8, 8, 65_536
# Digits of a digest that are stored.
DIGITS = 32


def input_digests(session: Session) -> dict[str, str]:
    """Return a digest for each input of a session: `images of CAMERA`, `video of CAMERA`, ..., `truth`. Missing files count as missing.

    Raises:
        InputError: a file cannot be read.
    """
    digests = {}
    for view in session.views:
        sequences = {"images": session.image_path, "masks": session.mask_path}
        files = {
            "video": session.video_path(view),
            "background": session.background_path(view),
            "keypoints": session.keypoints_path(view),
            "extrinsics": session.camera_path(view),
        }
        for kind, path_of in sequences.items():
            paths = [path for frame in range(session.frames) if (path := path_of(view, frame)) is not None]
            if paths:
                digests[f"{kind} of {view.camera.name}"] = _digest(_of_sequence(paths))
        digests |= {f"{kind} of {view.camera.name}": _digest(_of_file(path)) for kind, path in files.items() if path is not None}
    if session.truth_path is not None:
        digests["truth"] = _digest(_of_file(session.truth_path))
    return digests


def _digest(pieces: Iterator[bytes]) -> str:
    digest = hashlib.sha256()
    for piece in pieces:
        digest.update(piece)
    return digest.hexdigest()[:DIGITS]


def _of_sequence(paths: list[Path]) -> Iterator[bytes]:
    for path in paths:
        yield f"{_size(path)} ".encode()
    for index in np.unique(np.linspace(0, len(paths) - 1, FRAMES).round().astype(int)):
        yield from _of_file(paths[index])


def _of_file(path: Path) -> Iterator[bytes]:
    size = _size(path)
    yield f"{size}\n".encode()
    if size is None:
        return
    try:
        with path.open("rb") as file:
            for start in np.unique(np.linspace(0, max(0, size - PIECE_BYTES), PIECES).round().astype(int)):
                file.seek(int(start))
                yield file.read(PIECE_BYTES)
    except OSError as error:
        raise input_error(path, f"cannot be read ({error.strerror})", "a file of the recording", "check its permissions") from None


def _size(path: Path) -> int | None:
    """Return the size of a regular file in bytes; None if there is none."""
    return path.stat().st_size if path.is_file() else None
