"""The results of a run while it is written: each is listed in the manifest as soon as it is complete."""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from bayes_body.base.errors import InputError
from bayes_body.results.storage.frame_files import FrameFiles
from bayes_body.results.storage.manifest import MadeOf, Manifest, read_manifest
from bayes_body.results.storage.names import OVERLAY_FILE
from bayes_body.results.storage.posterior_file import open_posterior

if TYPE_CHECKING:
    import xarray as xr


class Results:
    """What a run makes of its frames.

    Args:
        folder: the folder of the run.
        frames: all frames of the run.
    """

    def __init__(self, folder: Path, frames: FrameFiles):
        self.folder, self.files = folder, frames
        self._frames = MadeOf(len(frames), frames.last_digest)
        self._manifest = _manifest_of(folder, frames.run)

    def is_current(self, name: str) -> bool:
        """Return whether a file was made of exactly these frames, and has not changed since."""
        return self._manifest.is_current(self.folder, name, self._frames)

    def posterior(self) -> "xr.DataTree":
        """Return the tree of `posterior.nc`, opened lazily.

        Raises:
            InputError: it is not listed, or it has changed.
        """
        return open_posterior(self.folder, self._manifest)

    def is_drawn(self) -> bool:
        """Return whether the video and all stills are there, and were made of exactly these frames."""
        return self.is_current(OVERLAY_FILE) and all((self.folder / name).is_file() for name in self._manifest.stills)

    def add(self, name: str) -> None:
        """List a file that was just written.

        Raises:
            InputError: the file system does not accept the manifest.
        """
        self._manifest = self._manifest.with_result(self.folder, name, self._frames)
        self._manifest.write(self.folder)

    def add_pictures(self, stills: Iterable[Path]) -> None:
        """List the video and its stills, and remove stills that the run drew earlier, of fewer frames. Other files are not touched.

        Raises:
            InputError: the file system does not accept the manifest.
        """
        previous_stills, still_names = self._manifest.stills, [path.relative_to(self.folder).as_posix() for path in stills]
        self._manifest = self._manifest.model_copy(update={"stills": still_names})
        self.add(OVERLAY_FILE)
        for name in set(previous_stills) - set(still_names):
            (self.folder / name).unlink(missing_ok=True)


def _manifest_of(folder: Path, run: str) -> Manifest:
    """Return the manifest of the folder. If it is damaged or of another run, all results are written again."""
    try:
        manifest = read_manifest(folder)
    except InputError:
        return Manifest(run=run)
    return manifest if manifest.run == run else Manifest(run=run)
