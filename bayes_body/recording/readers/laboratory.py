"""Recordings of laboratories whose calibration states its unit and axes: one file, and videos whose names are, or end in, a camera's number."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from bayes_body.recording.readers.agreement.turned_pictures import assemble_upright
from bayes_body.recording.readers.assemble import Rig, only_file, saved, source_folder
from bayes_body.recording.readers.calibration import qualisys, vicon
from bayes_body.recording.readers.calibration.calibrated import Calibrated
from bayes_body.recording.readers.keypoints.imported import with_imported_keypoints
from bayes_body.recording.readers.options import Axis, Options, up_axis
from bayes_body.recording.session.session import Session


class Laboratory(NamedTuple):
    """A maker of calibrated cameras.

    Attributes:
        maker: its name.
        patterns: of the names of its calibrations, in millimetres.
        up: the axis that points up.
        read: `(path, note)` -> the cameras; `note` receives sentences about what was left out.
    """

    maker: str
    patterns: tuple[str, ...]
    up: Axis
    read: Callable[[Path, Callable[[str], None]], list[Calibrated]]


QUALISYS = Laboratory("Qualisys", ("*.qca.txt", "*.xml"), qualisys.UP, qualisys.read_qualisys)
VICON = Laboratory("Vicon", ("*.xcp",), vicon.UP, vicon.read_vicon)


def import_laboratory(laboratory: Laboratory, source: Path, folder: Path, options: Options) -> tuple[Session, list[str]]:
    """Write the session of a recording. Its files stay where they are.

    Args:
        laboratory: whose recording it is.
        source: holds the calibration, directly or in `calibration`, and the videos, directly or in `videos`.
        folder: the folder for `session.toml`; created if needed.
        options: the user's options. They may name another axis that points up.

    Returns:
        The saved session and remarks for the user, one sentence each.

    Raises:
        FaultyFileError: something in the source is missing or wrong; one sentence for each fault.
        InputError: `source` is not a folder, an option is wrong, or `folder` cannot be written.
    """
    expected = f"a folder with one calibration of {laboratory.maker} ({' or '.join(laboratory.patterns)}) and a video of each camera"
    source_folder(source, expected)
    notes: list[str] = []
    path = only_file([source / "calibration", source], laboratory.patterns, expected)
    rig = Rig(path, laboratory.read(path, notes.append), source, up_axis(options.up or laboratory.up, ""))
    session, remarks = assemble_upright(rig, folder.resolve(), f"{laboratory.maker} recording {source.resolve().name}", options)
    session, keypoint_remarks = with_imported_keypoints(session, options)
    return saved(session), [*notes, *remarks, *keypoint_remarks]
