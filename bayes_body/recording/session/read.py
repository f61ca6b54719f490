"""Read and write a session on disk: a folder with a `session.toml` (metres, degrees, pixels) that a person can edit.

A `session.toml` is written with comments for the person who edits it.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit
from tomlkit.items import Array, Table

from bayes_body.base.errors import input_error
from bayes_body.base.files.atomic import write_text
from bayes_body.base.files.read import check_native
from bayes_body.base.toml.read import read_toml, validate
from bayes_body.recording.session.schema import CameraTable, SessionFile, SubjectTable, to_radians
from bayes_body.recording.session.session import CameraSpec, CameraUncertainty, Segmentation, Session, Span, Subject, View

# Decimals of converted values (degrees, metres): finer than any measurement, so that reading and writing again changes nothing.
DECIMALS = 9


def document(session: Session) -> tomlkit.TOMLDocument:
    """The file as a tomlkit document: tables in reading order, with comments."""
    text = tomlkit.document()
    text.add(tomlkit.comment("A recording. Metres, pixels, degrees (keys that end in _deg). Relative image paths start at this file's folder."))
    text.add("title", tomlkit.item(session.title))
    _add(text, "up", session.up, "the world's axis that points up")
    _add(text, "fps", float(session.fps), "frames per second")
    _add(text, "frames", session.frames)
    _add(text, "first_frame", session.first_frame, "number of the first frame in the file names")
    if session.recorded is not None:
        comment = (
            "the whole recording: its first frame's number, and how many; the background is learned from all, and rows of files count from there"
        )
        _add(text, "recorded", list(session.recorded), comment)
    if session.truth is not None:
        _add(text, "truth", session.truth, "an .npz with the true `markers` (frame, marker, 3), metres, and their `names`")
    if session.calibration is not None:
        _add(text, "calibration", session.calibration, "from which the cameras were imported")
    text.add("subject", _subject_table(session.subject, session.positions))
    text.add("initial", _initial_table(session))
    if session.segmentation != type(session.segmentation)():
        text.add("segmentation", _segmentation_table(session.segmentation))
    cameras = tomlkit.aot()
    for view in session.views:
        cameras.append(_camera_table(view))
    text.add("camera", cameras)
    return text


def _add(table: Table | tomlkit.TOMLDocument, key: str, value: Any, comment: str | None = None) -> None:
    item = tomlkit.item(value)
    if comment:
        item.comment(comment)
    table.add(key, item)


def _subject_table(subject: Subject, positions: frozenset[str]) -> Table:
    table = tomlkit.table()
    if subject.body is not None:
        _add(table, "body", subject.body, "the names and dofs below belong to this body")
    if subject.height_m is not None:
        _add(table, "height_m", _rounded(subject.height_m))
    _add_mapping(table, "lengths_m", "from joint to joint", subject.lengths_m, _rounded)
    _add_mapping(table, "lengths_sd", "relative standard deviation; overall: the share that all have in common", subject.lengths_sd, _rounded)
    _add_mapping(table, "keypoint_offsets_m", "x, y, z of a keypoint beside its joint, in the joint's frame", subject.keypoint_offsets_m, _triple)
    _add_mapping(table, "keypoint_offsets_sd_m", "standard deviations; 0: nothing is said", subject.keypoint_offsets_sd_m, _triple)
    _add_mapping(table, "radii_m", "[base, tip] of each part", subject.radii_m, _radii)
    _add_mapping(table, "outline_radii_m", "radii as seen in the images, clothes included", subject.outline_radii_m, _radii)
    _add_mapping(table, "sections", "scale factors of a section's [x, y] radius", subject.sections, list)
    _add_motions(table, "motion_sd_deg", "motion_sd_m", "standard deviation of the change from one frame to the next", subject.motion_sd, positions)
    return table


def _radii(radii: tuple[float, float]) -> list[Any]:
    return [_rounded(radius) for radius in radii]


def _initial_table(session: Session) -> Table:
    table = tomlkit.table()
    table.add(tomlkit.comment("What is known about the pose of the first frame."))
    if session.fit_lengths:
        _add(table, "fit_lengths", True, "fit the segment lengths together with the pose")
    if session.fit_outline:
        _add(table, "fit_outline", True, "fit the apparent thickness of the body to the first frame's silhouettes")
    _add_motions(table, "angles_deg", "positions_m", None, session.initial, session.positions)
    _add_mapping(table, "markers_m", "x, y, z in the world", session.initial_markers, lambda point: [_rounded(value) for value in point])
    if session.initial_keypoints:
        cameras = tomlkit.table(is_super_table=True)
        for camera, keypoints in session.initial_keypoints.items():
            _add_mapping(cameras, camera, "column, row, confidence", keypoints, lambda point: [float(value) for value in point])
        table.add("keypoints_px", cameras)
    return table


def _segmentation_table(segmentation: Segmentation) -> Table:
    table = tomlkit.table()
    table.add(tomlkit.comment("How the person is separated from the background."))
    _add(table, "threshold", float(segmentation.threshold), "squared Mahalanobis distance at which foreground and background are equally likely")
    _add(table, "learning_frames", segmentation.learning_frames, "number of evenly spaced frames from which the background is learned")
    _add(table, "shadows", segmentation.shadows, "darker pixels with the background's colour count as background")
    _add(table, "follow_exposure", segmentation.follow_exposure, "match each image's brightness to the background's first")
    _add(table, "figures", segmentation.figures, "all, or near_body: what is large and away from the body counts as not seen")
    return table


def _add_motions(table: Table, angles: str, shifts: str, comment: str | None, values: Mapping[str, float], positions: frozenset[str]) -> None:
    """Add the angles of `values` (radians) in degrees under the key `angles`, and the positions (metres) under the key `shifts`."""
    _add_mapping(table, angles, comment, {k: v for k, v in values.items() if k not in positions}, _degrees)
    _add_mapping(table, shifts, comment, {k: v for k, v in values.items() if k in positions}, _rounded)


def _add_mapping(table: Table, key: str, comment: str | None, values: Mapping[str, Any], convert: Callable[[Any], Any]) -> None:
    if not values:
        return
    inner = tomlkit.table()
    if comment:
        inner.comment(comment)
    for name, value in values.items():
        inner.add(name, convert(value))
    table.add(key, inner)


def _camera_table(view: View) -> Table:
    camera, table = view.camera, tomlkit.table()
    _add(table, "name", camera.name)
    _add(table, "size_px", list(camera.size_px), "width, height")
    _add(table, "focal_px", list(camera.focal_px), "x, y")
    _add(table, "centre_px", list(camera.centre_px), "column, row; the first pixel's centre is (0, 0)")
    _add(table, "skew", float(camera.skew))
    _add(table, "distortion", list(camera.distortion), "k1, k2, p1, p2, k3 (OpenCV's order)")
    rows: Array = tomlkit.array()
    rows.extend(np.asarray(camera.rotation, float).tolist())
    table.add("rotation", rows.multiline(True).comment("X_camera = rotation X_world + translation"))
    _add(table, "translation_m", [_rounded(value) for value in camera.translation_m])
    if view.images is not None:
        _add(table, "images", view.images, "%04d: the frame's number in four digits")
    if view.video is not None:
        _add(table, "video", view.video)
    if view.video_fps is not None:
        _add(table, "video_fps", float(view.video_fps), "the rate that the video's file states; the camera filmed at the session's fps")
    if view.masks is not None:
        _add(table, "masks", view.masks, "white where the subject is")
    if view.background is not None:
        _add(table, "background", view.background, "the empty scene: an image or a video")
    if view.path is not None:
        _add(table, "path", view.path, "the camera moves: an .npz with its extrinsics in each frame; those above belong to the first frame")
    if view.keypoints is not None:
        _add(table, "keypoints", view.keypoints, "an .npz with the subject's keypoints in each frame")
    if view.offset:
        _add(table, "offset", view.offset, "the session's frame k is this camera's frame k + offset")
    if view.spans:
        comment = "[instant, frame, count] of each run of the video's frames on the camera's clock, which k + offset counts; elsewhere it has none"
        _add(table, "spans", [list(span) for span in view.spans], comment)
    _add_uncertainty(table, view.uncertainty)
    return table


def _add_uncertainty(table: Table, uncertainty: CameraUncertainty) -> None:
    if uncertainty.turn_sd is not None:
        _add(table, "turn_sd_deg", [_degrees(value) for value in uncertainty.turn_sd], "standard deviations about the camera's x, y, z")
    if uncertainty.move_sd_m is not None:
        _add(table, "move_sd_m", _triple(uncertainty.move_sd_m), "standard deviations along x, y, z")
    if uncertainty.focal_sd is not None:
        _add(table, "focal_sd", _rounded(uncertainty.focal_sd), "relative")
    if uncertainty.centre_sd_px is not None:
        _add(table, "centre_sd_px", [_rounded(value) for value in uncertainty.centre_sd_px], "column, row")
    if uncertainty.delay_s:
        _add(table, "delay_s", _rounded(uncertainty.delay_s), "seconds by which it is late against the first camera, beside its offset")
    if uncertainty.delay_sd_s is not None:
        _add(table, "delay_sd_s", _rounded(uncertainty.delay_sd_s), "standard deviation of the delay")


def _rounded(value: float) -> float:
    return round(float(value), DECIMALS)


def _triple(values: Iterable[float]) -> list[float]:
    return [_rounded(value) for value in values]


def _degrees(radians: float) -> float:
    return round(math.degrees(radians), DECIMALS)


FILE_NAME = "session.toml"


def load_session(path: Path | str) -> Session:
    """Load the session of a folder that holds `session.toml`, or of that file.

    Raises:
        InputError: no such file, not TOML, or a path that the libraries that read images and videos cannot open.
        FaultyFileError: the file has faults; one sentence for each.
    """
    path = Path(path)
    path = path / FILE_NAME if path.is_dir() else path
    check_native(path)
    return parse_session(read_toml(path), path.resolve().parent, str(path))


def parse_session(tables: Mapping[str, Any], folder: Path, subject: str) -> Session:
    """Build the session that the tables of a `session.toml` describe. Relative paths start at `folder`; error messages call the file `subject`.

    Raises:
        FaultyFileError: the tables have faults; one sentence for each.
    """
    table = validate(SessionFile, tables, subject)
    return Session(
        folder=folder,
        title=table.title,
        up=table.up,
        fps=table.fps,
        frames=table.frames,
        first_frame=table.first_frame,
        views=tuple(_view(camera) for camera in table.cameras),
        subject=_subject(table.subject),
        initial=to_radians(table.initial.angles_deg) | table.initial.positions_m,
        positions=table.positions,
        initial_markers=table.initial.markers_m,
        initial_keypoints=table.initial.keypoints_px,
        fit_lengths=table.initial.fit_lengths,
        fit_outline=table.initial.fit_outline,
        segmentation=Segmentation(**table.segmentation.model_dump()),
        truth=table.truth,
        recorded=table.recorded,
        calibration=table.calibration,
    )


def _view(table: CameraTable) -> View:
    camera = CameraSpec(
        name=table.name,
        size_px=table.size_px,
        focal_px=table.focal_px,
        centre_px=table.centre_px,
        skew=table.skew,
        distortion=table.distortion,
        rotation=np.array(table.rotation),
        translation_m=np.array(table.translation_m),
    )
    turn_sd = None
    if table.turn_sd_deg is not None:
        x, y, z = (math.radians(value) for value in table.turn_sd_deg)
        turn_sd = x, y, z
    uncertainty = CameraUncertainty(turn_sd, table.move_sd_m, table.focal_sd, table.centre_sd_px, table.delay_s, table.delay_sd_s)
    sources = (table.images, table.masks, table.video, table.background, table.offset, table.keypoints, table.path, table.video_fps)
    return View(camera, *sources, uncertainty, tuple(Span(*row) for row in table.spans))


def _subject(table: SubjectTable) -> Subject:
    motion_sd = to_radians(table.motion_sd_deg) | table.motion_sd_m
    measures = (table.lengths_m, table.radii_m, table.sections, motion_sd, table.outline_radii_m)
    return Subject(table.body, table.height_m, *measures, table.lengths_sd, table.keypoint_offsets_m, table.keypoint_offsets_sd_m)


def save_session(session: Session) -> Path:
    """Write `session.toml` into the session's folder. The folder is created if needed; angles and metres are rounded to 1e-9.

    Raises:
        InputError: the folder cannot be written.
    """
    path = session.folder / FILE_NAME
    try:
        session.folder.mkdir(parents=True, exist_ok=True)
        path.write_text(tomlkit.dumps(document(session)), encoding="utf-8")
    except OSError as error:
        raise input_error(path, f"cannot be written ({error.strerror})", "a folder for the session", "name a folder in which you can write") from None
    return path


def extend_session_file(path: Path, frames: int) -> None:
    """Write the number of frames of a recording that has become longer; all else in the file stays, comments included.

    Args:
        path: the `session.toml`.
        frames: the number of frames from the session's first one on. A smaller number than the file has changes nothing.

    Raises:
        InputError: the file cannot be read or written.
    """
    tables = read_toml(path)
    if tables["frames"] >= frames:
        return
    text = tomlkit.parse(path.read_text(encoding="utf-8-sig"))
    text["frames"] = frames
    if "recorded" in tables:
        start, count = tables["recorded"]
        text["recorded"] = [start, max(count, tables.get("first_frame", 0) - start + frames)]
    write_text(path, tomlkit.dumps(text))
