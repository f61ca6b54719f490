"""Import a recording of the PARSEC suite's bodytrack (Intel 2006; also the layout of Balan et al.'s data) as a session.

A PARSEC bodytrack folder has the cameras in `CALIB/CameraC.cal`, images in `CAMc`, silhouettes in `FGc`, all named `imageNNNN.bmp`.
"""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from bayes_body.base.errors import input_error
from bayes_body.recording.readers.agreement.option import Changes, changed, check_changes, describe_changes
from bayes_body.recording.readers.assemble import align, saved, source_folder, with_options, written
from bayes_body.recording.readers.calibration.calibrated import Calibrated
from bayes_body.recording.readers.excerpt import excerpt
from bayes_body.recording.readers.faults import Faults
from bayes_body.recording.readers.images import read_grey, read_mask
from bayes_body.recording.readers.keypoints.imported import with_imported_keypoints
from bayes_body.recording.readers.options import Options, check_fps, check_height
from bayes_body.recording.readers.parsec_files import read_calibration
from bayes_body.recording.readers.parsec_subject import POSITIONS, read_subject
from bayes_body.recording.session.session import Session, View

IMAGE = "image%04d.bmp"
REMARK_NO_MASKS = "There are no FG folders: the session has no silhouettes; they are computed from a background learned from its images."


class Recorded(NamedTuple):
    """The views, the number of the first image, the number of frames, and remarks for the user."""

    views: tuple[View, ...]
    first_frame: int
    frames: int
    remarks: list[str]


class _Camera(NamedTuple):
    number: int
    calibration: Path
    images: Path
    masks: Path | None


def read_views(source: Path) -> Recorded:
    """The cameras of a folder, with the folder's numbers.

    Raises:
        FaultyFileError: one sentence for each calibration, folder or image that is missing or cannot be used.
    """
    cameras = _cameras(source)
    folders = [folder for camera in cameras for folder in (camera.images, camera.masks) if folder is not None]
    frames = _frames(folders)
    faults, views = Faults(), []
    for camera in cameras:
        with faults.collect():
            views.append(_view(camera, frames[0]))
    for folder in folders:
        with faults.collect():
            _check_complete(folder, frames)
    faults.raise_any()
    return Recorded(tuple(view for view in views if view), frames[0], len(frames), [] if cameras[0].masks else [REMARK_NO_MASKS])


def _cameras(source: Path) -> list[_Camera]:
    calibrated = _numbered(source / "CALIB", r"Camera(\d+)\.cal")
    filmed, masked = _numbered(source, r"CAM(\d+)"), _numbered(source, r"FG(\d+)")
    if not calibrated:
        raise input_error(
            source / "CALIB", "no Camera*.cal in it", "a calibration for each camera", "name the folder that holds CALIB, CAM1, FG1 and so on"
        )
    faults = Faults()
    for number in sorted({*calibrated, *filmed, *masked}):
        needed = {"CALIB/Camera{}.cal": calibrated, "CAM{}": filmed} | ({"FG{}": masked} if masked else {})
        for pattern, present in needed.items():
            if number not in present:
                with faults.collect():
                    remedy = f"restore it, or move camera {number}'s other files away"
                    raise input_error(
                        source / pattern.format(number), "missing", f"the same files for camera {number} as for the other cameras", remedy
                    )
    faults.raise_any()
    return [_Camera(number, path, filmed[number], masked.get(number)) for number, path in sorted(calibrated.items())]


def _numbered(folder: Path, pattern: str) -> dict[int, Path]:
    paths = folder.iterdir() if folder.is_dir() else ()
    return {int(match[1]): path for path in paths if (match := re.fullmatch(pattern, path.name))}


def _frames(folders: Sequence[Path]) -> range:
    """All numbers from the first to the last image of any folder, so that a gap in one folder is noticed."""
    numbers = {number for folder in folders for number in _numbered(folder, r"image(\d{4})\.bmp")}
    if not numbers:
        raise input_error(folders[0], "no images in it", f"{IMAGE % 0}, {IMAGE % 1} and so on", "restore the images")
    return range(min(numbers), max(numbers) + 1)


def _check_complete(folder: Path, frames: range) -> None:
    missing = [number for number in frames if not (folder / (IMAGE % number)).exists()]
    if missing:
        problem = f"{len(missing)} of {len(frames)} images are missing, the first is {IMAGE % missing[0]}"
        remedy = "restore them, or remove the same frames at the start or end of all other folders"
        raise input_error(folder, problem, f"{IMAGE % frames[0]} to {IMAGE % frames[-1]}, as in the other folders", remedy)


def _view(camera: _Camera, first_frame: int) -> View | None:
    """A camera's view; None if its first image is missing, which `_check_complete` reports."""
    faults, calibration, size = Faults(), None, None
    with faults.collect():
        calibration = read_calibration(camera.calibration)
    first, first_mask = (folder / (IMAGE % first_frame) if folder else None for folder in (camera.images, camera.masks))
    with faults.collect():
        if first and first.exists():
            height, width = read_grey(first).shape
            size = (width, height)
    with faults.collect():
        if first_mask and first_mask.exists():
            read_mask(first_mask, size)
    faults.raise_any()
    if calibration is None or size is None:
        return None
    spec = calibration._replace(name=camera.images.name).spec(size)
    return View(spec, _pattern(camera.images), _pattern(camera.masks) if camera.masks else None)


def _pattern(folder: Path) -> str:
    # Escape percent signs in the folder's name: they are not the frame number.
    return f"{folder.resolve()}/".replace("%", "%%") + IMAGE


# The format does not state it. The subject's steps and speed fit 60 (about 15 mm per frame).
FPS = 60.0


def import_parsec(source: Path, folder: Path, options: Options | None = None) -> tuple[Session, list[str]]:
    """Write the session of a bodytrack folder. Its images stay where they are.

    Args:
        source: holds CALIB, CAMc, FGc, BodyShapeParameters.txt, InitialPose.txt and PoseParameters.txt.
        folder: the folder for `session.toml`; created if needed.
        options: the user's options; the format fixes the unit and the up axis: millimetres and z.

    Returns:
        The saved session and remarks for the user, one sentence each.

    Raises:
        FaultyFileError: something in the source is missing or wrong; one sentence for each fault.
        InputError: `source` is not a folder, an option is wrong, or `folder` cannot be written.
    """
    options = options or Options()
    source_folder(source, "a bodytrack recording (CALIB, CAM1, FG1, InitialPose.txt ...)")
    check_height(options.height_m)
    check_fps(options.fps)
    faults, recorded, subject_files = Faults(), None, None
    with faults.collect():
        recorded = read_views(source)
    with faults.collect():
        subject_files = read_subject(source)
    if recorded is None or subject_files is None:
        faults.raise_any()
        raise AssertionError("a reader neither returned nor raised")
    check_changes(options.rig, [view.camera.name for view in recorded.views])
    recorded = recorded._replace(views=tuple(_changed(view, options.rig) for view in recorded.views))
    timing = align({view.camera.name: (recorded.first_frame, recorded.frames) for view in recorded.views}, options.offsets)
    recorded_session = Session(
        folder=folder.resolve(),
        title=f"bodytrack recording {source.resolve().name}",
        up="z",
        fps=options.fps or FPS,
        frames=timing.frames,
        first_frame=timing.first_frame,
        views=tuple(replace(view, offset=timing.offsets[view.camera.name]) for view in recorded.views),
        subject=subject_files.subject,
        initial=subject_files.initial,
        positions=frozenset(POSITIONS),
        calibration=written(source / "CALIB", folder),
    )
    session = excerpt(recorded_session, options.first_frame, options.frames)
    session, keypoint_remarks = with_imported_keypoints(with_options(session, options), options)
    remarks = [*describe_changes(options.rig), *recorded.remarks, *subject_files.remarks, *timing.remarks, *_left_out(recorded_session, session)]
    remarks += [*([] if options.fps else [_fps_remark()]), *keypoint_remarks]
    return saved(session), [remark for remark in remarks if not (options.masks and remark == REMARK_NO_MASKS)]


def _changed(view: View, changes: Changes) -> View:
    """Return the view with the changes of the calibration that the user asks for."""
    size_px = view.camera.size_px
    # The format does not state the size of its pictures.
    return replace(view, camera=changed(Calibrated.from_spec(view.camera)._replace(size_px=None), changes, size_px).spec(size_px))


def _left_out(recording: Session, session: Session) -> list[str]:
    if not recording.initial or session.first_frame == recording.first_frame:
        return []
    return [
        f"The recording's first pose belongs to frame {recording.first_frame} and is left out: the session begins at frame {session.first_frame}."
    ]


def _fps_remark() -> str:
    return f"The recording does not state its frame rate: {FPS:g} frames per second are assumed; correct fps in session.toml if this is wrong."
