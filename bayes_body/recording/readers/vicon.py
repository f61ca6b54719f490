"""Import a recording of Vicon's video cameras: one `*.xcp`, and videos whose names are, or end in, a camera's number."""

from pathlib import Path

from bayes_body.recording.readers.assemble import Rig, assemble, only_file, saved, source_folder
from bayes_body.recording.readers.calibration_vicon import UP, read_vicon
from bayes_body.recording.readers.imported_keypoints import with_imported_keypoints
from bayes_body.recording.readers.options import Options, up_axis
from bayes_body.recording.session.session import Session

WHAT = "a folder with one calibration of Vicon (*.xcp) and a video of each camera"


def import_vicon(source: Path, folder: Path, options: Options | None = None) -> tuple[Session, list[str]]:
    """Write the session of a Vicon recording. Its files stay where they are.

    The unit is millimetres, and z points up unless the options name another axis.

    Args:
        source: holds the calibration, directly or in `calibration`, and the videos, directly or in `videos`.
        folder: the folder for `session.toml`; created if needed.
        options: the user's options.

    Returns:
        The saved session and remarks for the user, one sentence each.

    Raises:
        FaultyFileError: something in the source is missing or wrong; one sentence for each fault.
        InputError: `source` is not a folder, an option is wrong, or `folder` cannot be written.
    """
    options = options or Options()
    source_folder(source, WHAT)
    notes: list[str] = []
    path = only_file([source / "calibration", source], ("*.xcp",), WHAT, notes.append)
    rig = Rig(path, read_vicon(path, notes.append), source, up_axis(options.up or UP, ""))
    session, remarks = assemble(rig, folder.resolve(), f"Vicon recording {source.resolve().name}", options)
    session, keypoint_remarks = with_imported_keypoints(session, options)
    return saved(session), [*notes, *remarks, *keypoint_remarks]
