"""A recording of Qualisys Track Manager's video cameras as a session: one `*.qca.txt` (or xml), and videos whose names are, or end in, a serial."""

from pathlib import Path

from bayes_body.recording.assemble import Rig, assemble, only_file, saved, source_folder
from bayes_body.recording.calibration_qualisys import UP, read_qualisys
from bayes_body.recording.imported_keypoints import with_imported_keypoints
from bayes_body.recording.options import Options, up_axis
from bayes_body.session.session import Session

WHAT = "a folder with one calibration of Qualisys Track Manager (*.qca.txt or *.xml) and a video of each camera"


def import_qualisys(source: Path, folder: Path, options: Options | None = None) -> tuple[Session, list[str]]:
    """Write the session of a Qualisys recording; its files stay where they are.

    The unit is millimetres, and z points up unless the options say otherwise.

    Args:
        source: holds the calibration, itself or in `calibration`, and the videos, itself or in `videos`.
        folder: where `session.toml` is to lie; made if need be.
        options: what the user said.

    Returns:
        The session as saved, and remarks for the user, a sentence each.

    Raises:
        FaultyFileError: one sentence for each thing in the source that is missing or wrong.
        InputError: `source` is no folder, an option is wrong, or `folder` cannot be written.
    """
    options = options or Options()
    source_folder(source, WHAT)
    path = only_file([source / "calibration", source], ("*.qca.txt", "*.xml"), WHAT)
    rig = Rig(path, read_qualisys(path), source, up_axis(options.up or UP, ""))
    session, remarks = assemble(rig, folder.resolve(), f"Qualisys recording {source.resolve().name}", options)
    session, told = with_imported_keypoints(session, options)
    return saved(session), [*remarks, *told]
