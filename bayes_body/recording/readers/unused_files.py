"""What an import found in its source and did not read: calibrations, recordings, keypoints, masks; and why."""

import re
from collections.abc import Iterator, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import NamedTuple

from bayes_body.recording.readers.assemble import PLACES
from bayes_body.recording.readers.calibration.toml import is_calibration
from bayes_body.recording.readers.file_names import composed
from bayes_body.recording.readers.keypoints.imported import FOLDER
from bayes_body.recording.readers.keypoints.pose_files.find import PoseFiles
from bayes_body.recording.readers.options import Options
from bayes_body.recording.readers.sources import recordings
from bayes_body.recording.session.session import Session

CALIBRATIONS = (".toml", ".xcp", ".qca.txt")
# Names of folders of keypoints and of masks by the habit of programs.
POSES, MASKS = ("pose", "poses", "keypoints", "openpose"), ("masks", "silhouettes")


class Unused(NamedTuple):
    """A file or folder that was not read, or the name of a camera without keypoints; and the reason."""

    path: Path | str
    reason: str


def unused_files(session: Session, source: Path, options: Options, poses: Path | None, files: PoseFiles) -> list[Unused]:
    """Return what was not read.

    Args:
        session: as imported.
        source: the folder from which it was imported.
        options: the user's options.
        poses: the folder of keypoints that was looked into, if any.
        files: what it has.
    """
    pictures = [*_recordings(session, source, options), *_masks(source, options)]
    return [*_calibrations(session, source), *pictures, *_keypoints(session, source, poses, files)]


def _calibrations(session: Session, source: Path) -> Iterator[Unused]:
    used = session.calibration_path
    if used is None:
        return
    for place in (source / "calibration", source):
        for path in sorted(place.iterdir()) if place.is_dir() else ():
            is_used = used.resolve() in (path.resolve(), path.resolve().parent)
            if path.is_file() and path.name.lower().endswith(CALIBRATIONS) and not is_used and is_calibration(path):
                yield Unused(path, "another calibration")


def _recordings(session: Session, source: Path, options: Options) -> Iterator[Unused]:
    """Videos and folders of images. A folder that the options name, and one in it, has another use."""
    files = [path for view in session.views for path in (session.video_path(view), session.background_path(view)) if path is not None]
    images = [path for view in session.views for path in (session.image_path(view, 0), session.mask_path(view, 0)) if path is not None]
    used = {path.resolve() for path in (*files, *(image.parent for image in images))}
    named = {path.resolve() for path in (options.masks, options.background) if path is not None}
    names = [view.camera.name for view in session.views]
    for place in [options.videos] if options.videos else [*(source / place for place in PLACES), source]:
        for path in recordings(place):
            if not {path.resolve(), path.resolve().parent} & (used | named) and path.name not in (*PLACES, *MASKS):
                stem = _stem(path)
                yield Unused(path, "another recording of this camera is used" if stem in names else f"no camera is called {stem}")


def _keypoints(session: Session, source: Path, poses: Path | None, files: PoseFiles) -> Iterator[Unused]:
    without = [view.camera.name for view in session.views if view.camera.name not in files.paths]
    for path in files.unused:
        stem = _stem(path).removesuffix("_json")
        likely = _likely_name(stem, without)
        suffix = "_json" if path.is_dir() else path.suffix
        yield Unused(path, f"no camera is called {stem}" + (f"; if it is that of {likely}, rename it {likely}{suffix}" if likely else ""))
    if poses is not None and files.paths:
        yield from (Unused(f"camera {name}", f"nothing in {poses.name} has its name: no keypoints") for name in without)
    for path in sorted(path for path in source.iterdir() if path.is_dir()):
        is_written = path.resolve() == (session.folder / FOLDER).resolve()
        is_read = poses is not None and (path.resolve().is_relative_to(poses.resolve()) or poses.resolve().is_relative_to(path.resolve()))
        if (path.name.lower() in POSES or path.name.endswith("_json")) and not is_written and not is_read:
            yield Unused(path, "keypoints are read with --keypoints" if poses is None else "--keypoints names another folder")


def _masks(source: Path, options: Options) -> Iterator[Unused]:
    if options.masks is None:
        yield from (Unused(source / name, "masks are read with --masks") for name in MASKS if (source / name).is_dir())


def _stem(path: Path) -> str:
    return composed(path.name if path.is_dir() else path.stem)


def _likely_name(stem: str, names: Sequence[str]) -> str | None:
    """The name that a file probably means: the one with which it begins, the same without leading zeros, or a similar one."""
    begins = [name for name in names if stem.startswith(name)]
    equal = [name for name in names if _without_zeros(name) == _without_zeros(stem)]
    close = get_close_matches(stem, names, n=1, cutoff=0.6)
    return max(begins, key=len) if begins else next(iter((*equal, *close)), None)


def _without_zeros(name: str) -> str:
    return re.sub(r"(?<!\d)0+(?=\d)", "", name.lower())
