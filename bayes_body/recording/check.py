"""Whether a session's files are there and are what its cameras say, without reading them all."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from bayes_body.errors import wrong
from bayes_body.recording.faults import Faults
from bayes_body.recording.images import read_grey, read_mask
from bayes_body.session import Session, View


def check_session(session: Session) -> None:
    """Look for every file of every frame by name, and read the first and the last frame of every camera.

    Raises:
        FaultyFileError: one sentence for each series with missing files, and for each image that cannot be used.
    """
    faults = Faults()
    for view in session.views:
        for kind, paths in _series(session, view):
            with faults.collect():
                _check_present(f"{session.title}: camera '{view.camera.name}'", kind, paths)
            read = read_mask if kind == "masks" else read_grey
            # A missing file is in the sentence above already.
            for path in (path for path in dict.fromkeys((paths[0], paths[-1])) if path.exists()):
                with faults.collect():
                    read(path, view.camera.size_px)
    faults.raise_any()


def _series(session: Session, view: View) -> Iterator[tuple[str, list[Path]]]:
    yield "images", [session.image_path(view, k) for k in range(session.frames)]
    masks = [session.mask_path(view, k) for k in range(session.frames)]
    if view.masks is not None:
        yield "masks", [path for path in masks if path is not None]


def _check_present(owner: str, kind: str, paths: Sequence[Path]) -> None:
    missing = [path for path in paths if not path.exists()]
    if missing:
        found = f"{len(missing)} of {len(paths)} {kind} are missing, the first is {missing[0]}"
        remedy = f"restore them, or correct {kind}, first_frame and frames in session.toml"
        raise wrong(owner, found, "a file for every frame", remedy)
