"""Read and write a session on disk: a folder with a `session.toml` (metres, degrees, pixels) that a person can edit."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from bayes_body.base.errors import input_error
from bayes_body.base.files.read import check_native
from bayes_body.base.toml.read import read_toml, validate
from bayes_body.recording.session.document import document
from bayes_body.recording.session.schema import CameraTable, SessionFile, SubjectTable, to_radians
from bayes_body.recording.session.session import CameraSpec, Segmentation, Session, Subject, View

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


def parse_session(tables: Mapping[str, Any], folder: Path, where: str) -> Session:
    """Build the session that the tables of a `session.toml` describe. Relative paths start at `folder`; error messages call the file `where`.

    Raises:
        FaultyFileError: the tables have faults; one sentence for each.
    """
    table = validate(SessionFile, tables, where)
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
    return View(camera, table.images, table.masks, table.video, table.background, table.offset, table.keypoints, table.path, table.video_fps)


def _subject(table: SubjectTable) -> Subject:
    motion_sd = to_radians(table.motion_sd_deg) | table.motion_sd_m
    return Subject(table.body, table.height_m, table.lengths_m, table.radii_m, table.sections, motion_sd, table.outline_radii_m)


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
