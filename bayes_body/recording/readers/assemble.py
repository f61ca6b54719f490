"""Build a session from calibrated cameras and a folder with their recordings. All importers share this.

The cameras' frames are aligned: cameras may start at different times, number their frames differently and record different numbers of frames.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from bayes_body.base.errors import InputError, input_error, nearest
from bayes_body.recording.readers.agreement.option import Changes, changed, check_changes, describe_changes, describe_turns, upright
from bayes_body.recording.readers.agreement.plausibility import describe_implausible
from bayes_body.recording.readers.agreement.sizes import OtherSize, check_sizes
from bayes_body.recording.readers.calibration.calibrated import Calibrated, check_rig
from bayes_body.recording.readers.excerpt import excerpt
from bayes_body.recording.readers.faults import Faults
from bayes_body.recording.readers.file_names import child
from bayes_body.recording.readers.images import read_mask
from bayes_body.recording.readers.options import Axis, Options, check_fps, check_height
from bayes_body.recording.readers.sources import Series, Source, deeper_folders, find_background, find_series, find_source, has_source, settled_size
from bayes_body.recording.readers.truth import read_truth
from bayes_body.recording.readers.videos.pairing import SAME_RATE, Paired, pair_frames
from bayes_body.recording.session.read import load_session, save_session
from bayes_body.recording.session.session import Session, Subject, View


class Timing(NamedTuple):
    """The session's frames: their count, the number of the first, each camera's offset by name, and remarks for the user."""

    frames: int
    first_frame: int
    offsets: dict[str, int]
    remarks: list[str]


def align(counts: Mapping[str, tuple[int, int]], offsets: Mapping[str, int], incomplete: Collection[str] = ()) -> Timing:
    """The frames that all cameras have.

    Args:
        counts: each camera's first frame number and number of frames.
        offsets: how many frames a camera is ahead, for some of the cameras. The session starts where the last camera starts.
        incomplete: cameras that lack some of their frames.

    Raises:
        FaultyFileError: an offset for an unknown camera, or no frame that all cameras have.
    """
    faults = Faults()
    for name in offsets:
        with faults.collect():
            if name not in counts:
                raise InputError(f"--offset: '{name}': no such camera; {nearest(name, counts)}")
    faults.raise_any()
    latest = max(0, -min((offsets.get(name, 0) for name in counts), default=0))
    skipped = {name: latest + offsets.get(name, 0) for name in counts}
    remaining = {name: count - skipped[name] for name, (_, count) in counts.items()}
    frames = min(remaining.values())
    if frames < 1:
        name = min(remaining, key=lambda camera: remaining[camera])
        raise input_error(
            f"camera '{name}'", f"{counts[name][1]} frames, all before the session's first", "frames that all cameras have", "correct --offset"
        )
    starts = {name: first + skipped[name] for name, (first, _) in counts.items()}
    first_frame = min(starts.values())
    return Timing(frames, first_frame, {name: start - first_frame for name, start in starts.items()}, _remarks(remaining, frames, latest, incomplete))


def _remarks(remaining: Mapping[str, int], frames: int, latest: int, incomplete: Collection[str]) -> list[str]:
    remarks = []
    if latest:
        remarks.append(f"The session starts {latest} frames into the recording, where the camera with the smallest offset does.")
    if max(remaining.values()) > frames:
        listed = ", ".join(f"{name} {count}{' with those that it lacks' if name in incomplete else ''}" for name, count in remaining.items())
        remarks.append(f"Cameras have different numbers of frames ({listed}): the session has the {frames} that all have.")
    return remarks


# Recordings are in one of these folders of a project, or in the project's folder itself.
PLACES = ("videos", "images")
# Named in a sentence.
MOST_FOLDERS = 3


class Filmed(NamedTuple):
    """A calibrated camera, its recording, and a remark about the image size (or None)."""

    camera: Calibrated
    source: Source
    remark: str | None


class Rig(NamedTuple):
    """What a laboratory provides: the path of the calibration, its cameras, the folder with the recordings, and the axis that points up."""

    calibration: Path
    cameras: Sequence[Calibrated]
    folder: Path
    up: Axis


def assemble(rig: Rig, folder: Path, title: str, options: Options) -> tuple[Session, list[str]]:
    """Build the session of a rig's recordings. The recordings stay where they are; nothing is written.

    Args:
        rig: the cameras and the folder with their recordings.
        folder: the session's folder; paths inside it are written relative to it.
        title: one line for the reader.
        options: the user's options.

    Returns:
        The session and remarks for the user, one sentence each.

    Raises:
        FaultyFileError: something is missing or wrong; one sentence for each fault.
    """
    check_height(options.height_m)
    check_fps(options.fps)
    check_changes(options.rig, [camera.name for camera in rig.cameras])
    filmed = _filmed(rig, options.videos, options.rig)
    check_rig(rig.calibration, [recording.camera for recording in filmed])
    clocks = {recording.camera.name: recording.source.clock for recording in filmed if recording.source.clock is not None}
    paired = pair_frames(clocks, options.fps, options.resample, options.offsets)
    counts = {recording.camera.name: (recording.source.first, recording.source.count) for recording in filmed}
    incomplete = {name for name, runs in paired.spans.items() if sum(run.frames for run in runs) < paired.counts[name]}
    timing = align(counts | {name: (0, count) for name, count in paired.counts.items()}, options.offsets, incomplete)
    views = tuple(_view(recording, folder, timing.offsets[recording.camera.name], paired) for recording in filmed)
    subject = Subject(height_m=options.height_m)
    calibration = written(rig.calibration, folder)
    recorded_session = Session(folder, title, rig.up, paired.fps, timing.frames, timing.first_frame, views, subject, calibration=calibration)
    session = excerpt(recorded_session, options.first_frame, options.frames)
    turns = describe_turns([recording.camera for recording in filmed])
    remarks = [*describe_changes(options.rig), *turns, *_common_remarks(filmed), *paired.remarks, *timing.remarks]
    remarks += describe_implausible([view.camera for view in session.views], rig.calibration, rig.up)
    return with_options(session, options), [*remarks, *([] if options.masks else [_no_masks(options)])]


def _common_remarks(filmed: Sequence[Filmed]) -> list[str]:
    """The remarks about image sizes, each with all cameras of which it is said."""
    remarks = dict.fromkeys(recording.remark for recording in filmed if recording.remark)
    return [f"{', '.join(recording.camera.name for recording in filmed if recording.remark == remark)}: {remark}" for remark in remarks]


def _no_masks(options: Options) -> str:
    scene = f"the empty scene in {options.background}" if options.background else "a background learned from the recording"
    return f"There are no masks: silhouettes are computed from {scene}; give masks with --masks."


def _filmed(rig: Rig, videos: Path | None, changes: Changes) -> list[Filmed]:
    faults, recordings = Faults(), list[tuple[Calibrated, Source]]()
    places = [videos] if videos else [*(rig.folder / place for place in PLACES if (rig.folder / place).is_dir()), rig.folder]
    _check_places(places, rig)
    for camera in rig.cameras:
        with faults.collect():
            source = find_source(places, camera.name)
            recordings.append((changed(upright(camera, changes, source.size_px), changes, source.size_px), source))
    faults.raise_any()
    filmed, unfit = list[Filmed](), dict[str, OtherSize]()
    for camera, source in recordings:
        with faults.collect():
            try:
                filmed.append(Filmed(camera, source, settled_size(f"camera '{camera.name}'", camera.size_px, source)))
            except InputError:
                unfit[camera.name] = OtherSize(source.path.name, source.size_px, camera.size_px or source.size_px)
                raise
    check_sizes(unfit, len(recordings))
    faults.raise_any()
    return filmed


def _check_places(places: Sequence[Path], rig: Rig) -> None:
    """Refuse places without any camera's recording, if folders in them have all recordings."""
    names = [camera.name for camera in rig.cameras]
    if any(has_source(places, name) for name in names):
        return
    deeper = [folder for folder in deeper_folders(places[-1], names[0]) if all(has_source([folder], name) for name in names)]
    if deeper:
        problem = f"no recording of a camera; there are some in {', '.join(map(str, deeper[:MOST_FOLDERS]))}"
        raise input_error(" and ".join(map(str, places)), problem, "a video or a folder of images for each camera", f"give --videos {deeper[0]}")


def _view(filmed: Filmed, folder: Path, offset: int, paired: Paired) -> View:
    camera, source, fps = filmed.camera.spec(filmed.source.size_px), filmed.source, paired.fps
    if source.series is None:
        # --fps and --resample override a video's rate. The session keeps both, since another rate would mean another video.
        stated = source.fps if abs(source.fps - fps) > SAME_RATE * fps and source.fps > 0 else None
        return View(camera, video=written(source.path, folder), offset=offset, video_fps=stated, spans=paired.spans.get(camera.name, ()))
    return View(camera, images=_pattern(source.series, folder), offset=offset)


def written(path: Path, folder: Path) -> str:
    """The path as a session in `folder` writes it: relative if it is inside the folder, else absolute."""
    path, folder = path.resolve(), folder.resolve()
    return str(path.relative_to(folder)) if path.is_relative_to(folder) else str(path)


def _pattern(series: Series, folder: Path) -> str:
    # Escape percent signs in the folder's name: they are not the frame number.
    parent = written(series.folder, folder).replace("%", "%%")
    return series.name if parent == "." else f"{parent}/{series.name}"


def with_options(session: Session, options: Options) -> Session:
    """Add the user's masks, empty scene, truth and height to a session.

    Raises:
        FaultyFileError: one of them is missing or wrong; one sentence for each fault.
    """
    faults, views = Faults(), []
    for view in session.views:
        with faults.collect():
            views.append(_with_pictures(session, view, options))
    truth = session.truth
    if options.truth is not None:
        with faults.collect():
            read_truth(options.truth, session.frames, session.skipped)
            truth = written(options.truth, session.folder)
    faults.raise_any()
    subject = session.subject if options.height_m is None else replace(session.subject, height_m=options.height_m)
    return replace(session, views=tuple(views), subject=subject, truth=truth)


def _with_pictures(session: Session, view: View, options: Options) -> View:
    name, size = view.camera.name, view.camera.size_px
    if options.masks is not None:
        series = find_series(child(options.masks, name))
        numbers = [number for frame in range(session.frames) if (number := session.file_number(view, frame)) is not None]
        if not numbers:
            raise input_error(f"camera '{name}'", "no frame in the session", "at least one", "choose other frames with --first-frame and --frames")
        first, last = numbers[0], numbers[-1]
        if series.first > first or series.first + series.count <= last:
            problem = f"numbers {series.first} to {series.first + series.count - 1}"
            remedy = "number the masks like the camera's frames; frames of a video count from 0"
            raise input_error(f"--masks {options.masks / name}", problem, f"{first} to {last}, this camera's frames in the session", remedy)
        read_mask(series.path(first), size)
        view = replace(view, masks=_pattern(series, session.folder))
    if options.background is not None:
        view = replace(view, background=written(find_background(options.background, name, size), session.folder))
    return view


def saved(session: Session) -> Session:
    """Write the session and read it back, so that the caller works with the rounded values of the file.

    Raises:
        InputError: the folder cannot be written.
    """
    return load_session(save_session(session))


def source_folder(source: Path, expected: str) -> Path:
    """Return the folder if it exists.

    Raises:
        InputError: it does not exist.
    """
    if not source.is_dir():
        raise input_error(source, "no such folder", expected, "check the path")
    return source


def only_file(places: Sequence[Path], patterns: Sequence[str], expected: str, is_right: Callable[[Path], bool] | None = None) -> Path:
    """The single file that matches one of the patterns, in the first place that has a match.

    Args:
        places: folders.
        patterns: of files' names.
        expected: what there should be, in error messages.
        is_right: whether a file is of the right kind; asked where several match.

    Raises:
        InputError: there is none, or there are several.
    """
    by_place = {place: sorted({path for pattern in patterns for path in place.glob(pattern) if path.is_file()}) for place in places}
    matching = [place for place, paths in by_place.items() if paths]
    if not matching:
        raise input_error(places[-1], f"no {' or '.join(patterns)} in it", expected, "name the folder that holds the calibration and the videos")
    paths = by_place[matching[0]]
    if len(paths) > 1 and is_right is not None:
        paths = [path for path in paths if is_right(path)] or paths
    if len(paths) > 1:
        names = ", ".join(path.name for path in paths)
        raise input_error(matching[0], f"{len(paths)} calibrations ({names})", expected, "keep only one of them there")
    return paths[0]
