"""`manifest.json`: what a run made of its frames, with a checksum of each file; and digests of the recording.

A result is used only if it is the one that the manifest lists. The manifest says from which frames a result was made: their number, and the digest of
the last one, which depends on all frames before it.

The digests of a recording tell whether images, videos and other files are still those from which a run was made. They use the size of each file, and
the content of some evenly spaced files of a sequence, or of pieces of a long file.
"""

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from bayes_body.base.errors import input_error
from bayes_body.base.files.atomic import write_text
from bayes_body.base.files.read import parse_json, read_text
from bayes_body.recording.session.session import Session
from bayes_body.results.storage.names import MANIFEST_FILE, OVERLAY_FOLDER

Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
RunId = Annotated[str, Field(pattern=r"^[0-9a-f]{16}$")]
# The only names that a manifest may list; other paths in a stranger's manifest are not touched.
STILL = rf"^{OVERLAY_FOLDER}/frame_\d{{6,9}}\.png$"
KIND = "the list of a run's results"
AGAIN = "write it again with `bayes-body track SESSION --out RUN --resume`"


class MadeOf(NamedTuple):
    """The frames of which a result was made: their number, and the digest of the last one."""

    number: int
    last: str


class Result(BaseModel):
    """One file of a run: its SHA-256, and the frames of which it was made."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)
    sha256: Digest
    frames: Annotated[int, Field(ge=1)]
    last: str


class Manifest(BaseModel):
    """The whole file: the id of the run, results by name, and the stills of the overlay."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)
    run: RunId
    results: dict[str, Result] = {}
    stills: list[Annotated[str, Field(pattern=STILL)]] = []

    def is_current(self, folder: Path, name: str, frames: MadeOf) -> bool:
        """Return whether a file is listed, was made of exactly these frames, and has not changed since."""
        result, path = self.results.get(name), folder / name
        return result is not None and (result.frames, result.last) == frames and path.is_file() and sha256_of(path) == result.sha256

    def with_result(self, folder: Path, name: str, frames: MadeOf) -> "Manifest":
        """Return the manifest with a file that was just written."""
        result = Result(sha256=sha256_of(folder / name), frames=frames.number, last=frames.last)
        return self.model_copy(update={"results": {**self.results, name: result}})

    def write(self, folder: Path) -> None:
        """Write `manifest.json`, either completely or not at all.

        Raises:
            InputError: the file system does not accept it.
        """
        write_text(folder / MANIFEST_FILE, self.model_dump_json(indent=2) + "\n")


def read_manifest(folder: Path) -> Manifest:
    """Return the manifest of a run.

    Raises:
        InputError: there is none, or it is damaged.
    """
    path = folder / MANIFEST_FILE
    listed = parse_json(read_text(path, KIND), path, KIND, AGAIN)
    try:
        return Manifest.model_validate(listed)
    except ValidationError as error:
        raise input_error(path, f"damaged ({error.errors()[0]['msg']})", KIND, AGAIN) from None


def check_result(folder: Path, manifest: Manifest, name: str) -> Result:
    """Return what the manifest says of a file, after a check that the file has not changed since it was written.

    Raises:
        InputError: the file is not listed, or it has changed.
    """
    result = manifest.results.get(name)
    if result is None:
        raise input_error(folder / name, f"not listed in {MANIFEST_FILE}", "a file that the run wrote", AGAIN)
    if sha256_of(folder / name) != result.sha256:
        raise input_error(folder / name, "was changed since it was written (its SHA-256 is another)", "the file that the run wrote", AGAIN)
    return result


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file, as hexadecimal digits.

    Raises:
        InputError: it cannot be read.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise input_error(path, f"cannot be read ({error.strerror})", "a file of the run", "check its permissions") from None


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
