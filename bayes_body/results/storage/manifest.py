"""`manifest.json`: what a run made of its frames, with a checksum of each file. A result is used only if it is the one that the manifest lists.

The manifest says of which frames a result was made: their number, and the digest of the last one, which depends on all frames before it.
"""

import hashlib
from pathlib import Path
from typing import Annotated, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from bayes_body.base.errors import input_error
from bayes_body.base.files.atomic import write_text
from bayes_body.base.files.text import parse_json, read_text
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
