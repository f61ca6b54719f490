"""The table at the end of an import: what was read from where, and what was not used and why."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from bayes_body.recording.readers.keypoints.imported import FACES_AND_HANDS
from bayes_body.recording.readers.keypoints.openpose import LAYOUTS
from bayes_body.recording.readers.keypoints.pose_files.find import PoseFiles, find_pose_files, program_of
from bayes_body.recording.readers.keypoints.series import read_series
from bayes_body.recording.readers.options import Options
from bayes_body.recording.readers.sources import find_series
from bayes_body.recording.readers.unused_files import unused_files
from bayes_body.recording.readers.videos.video import probe
from bayes_body.recording.session.session import Session, View

# Columns of a line, of a path, and how many unused files are listed.
WIDTH, WIDEST_PATH, MOST_UNUSED = 100, 30, 12
HEADINGS = ("camera", "recording", "frames", "per s", "keypoints", "person", "masks")
NOTHING = "-"


def describe_import(session: Session, source: Path, options: Options, poses: Path | None = None) -> list[str]:
    """Return the lines of the table, at most 100 columns wide.

    Args:
        session: as imported.
        source: the folder from which it was imported; paths are written relative to it.
        options: the user's options.
        poses: the folder in which the laboratory's program writes keypoints, which is read without an option.

    Raises:
        InputError: a recording or a file of keypoints cannot be read any more.
    """
    folder = options.keypoints or poses
    files = find_pose_files(folder, [view.camera.name for view in session.views]) if folder else PoseFiles({}, [])
    lines = [f"{name:<12}{text}" for name, text in _sources(session, source, files)]
    lines += _aligned([HEADINGS, *(_camera_row(session, view, source, files) for view in session.views)])
    unused = unused_files(session, source, options, folder, files)
    if unused:
        rows = [(entry.path if isinstance(entry.path, str) else _short(entry.path, source), entry.reason) for entry in unused[:MOST_UNUSED]]
        if len(unused) > MOST_UNUSED:
            rows.append((f"and {len(unused) - MOST_UNUSED} more", ""))
        lines += ["Not used:", *(f"  {line}" for line in _aligned(rows))]
    return [line[:WIDTH].rstrip() for line in lines]


def _sources(session: Session, source: Path, files: PoseFiles) -> Iterator[tuple[str, str]]:
    """What is read for all cameras."""
    if session.calibration_path is not None:
        centres = np.array([-view.camera.rotation.T @ view.camera.translation_m for view in session.views])
        apart_m = float(np.linalg.norm(centres[:, None] - centres, axis=-1).max())
        extent = f", at most {apart_m:.3g} m apart" if len(centres) > 1 else ""
        yield "calibration", f"{_short(session.calibration_path, source)}: {len(centres)} camera{'s' if len(centres) > 1 else ''}{extent}"
    names = [read_series(path).names for view in session.views if (path := session.keypoints_path(view)) is not None]
    if names and files.paths:
        programs = sorted({program for path in files.paths.values() if path.is_file() and (program := program_of(path))})
        written = f", files of {' and '.join(programs)}" if programs else ""
        yield "keypoints", f"{_describe_order(names[0])}{written}"
    for name, path in (("truth", session.truth_path), ("background", session.background_path(session.views[0]))):
        if path is not None:
            yield name, _short(path, source)


def _describe_order(names: tuple[str, ...]) -> str:
    layouts = {tuple(name for name in keypoints if not name.startswith(FACES_AND_HANDS)): layout for layout, keypoints in LAYOUTS.items()}
    return f"order {layouts[names]}" if names in layouts else f"{len(names)} points"


def _camera_row(session: Session, view: View, source: Path, files: PoseFiles) -> tuple[str, ...]:
    image, mask = session.image_path(view, 0), session.mask_path(view, 0)
    recording = image.parent if image is not None else session.folder / (view.video or "")
    total = probe(recording).frames if image is None else find_series(recording).count
    frames = f"{session.frames} of {total} from {session.number(view, 0)}"
    keypoints = files.paths.get(view.camera.name) if view.keypoints is not None else None
    masks = _short(mask.parent, source) if mask is not None else NOTHING
    shown = _short(keypoints, source) if keypoints else NOTHING
    return view.camera.name, _short(recording, source), frames, f"{view.video_fps or session.fps:g}", shown, _share_shown(session, view), masks


def _share_shown(session: Session, view: View) -> str:
    """In how many of the session's frames the camera's keypoints show the person."""
    path = session.keypoints_path(view)
    if path is None:
        return NOTHING
    count = int((read_series(path).keypoints[..., 2] > 0).any(axis=1).sum())
    return f"{count} of {session.frames}"


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return ["  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def _short(path: Path, source: Path) -> str:
    """The path relative to the source, or the source's own name; the end of it, if it is long."""
    path, source = path.resolve(), source.resolve()
    inside = path.is_relative_to(source) and path != source
    text = str(path.relative_to(source)) if inside else path.name if path == source else str(path)
    return text if len(text) <= WIDEST_PATH else f"...{text[3 - WIDEST_PATH :]}"
