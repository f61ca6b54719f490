"""Import a project of Pose2Sim: `calibration/*.toml`, `*.qca.txt` or `*.xcp`, and for each camera `videos/NAME.mp4` and keypoints in `pose`."""

from collections.abc import Callable
from pathlib import Path

from bayes_body.base.errors import input_error
from bayes_body.recording.readers.agreement.turned_pictures import assemble_upright
from bayes_body.recording.readers.assemble import Rig, only_file, saved, source_folder
from bayes_body.recording.readers.calibration.toml import is_calibration, read_calibration_toml
from bayes_body.recording.readers.keypoints.imported import with_imported_keypoints
from bayes_body.recording.readers.laboratory import QUALISYS, VICON
from bayes_body.recording.readers.options import Options, metres_per_unit, up_axis
from bayes_body.recording.session.session import Session

WHAT = "a project of Pose2Sim (calibration, videos, pose)"
# The folder in which Pose2Sim writes keypoints.
POSES = "pose"
# Of calibrations that state unit and axes.
LABORATORIES = {".txt": QUALISYS, ".xcp": VICON}
WHY_UP = "Pose2Sim's toml does not say which axis of its world points up; it depends on how the scene was measured"


def import_pose2sim(source: Path, folder: Path, options: Options | None = None) -> tuple[Session, list[str]]:
    """Write the session of a Pose2Sim project. Its files stay where they are.

    A toml is in metres, as Pose2Sim writes it, unless the options name another unit. The options must name the axis that points up.

    Args:
        source: the project's folder.
        folder: the folder for `session.toml`; created if needed.
        options: the user's options.

    Returns:
        The saved session and remarks for the user, one sentence each.

    Raises:
        FaultyFileError: something in the source is missing or wrong; one sentence for each fault.
        InputError: `source` is not a folder, an option is missing or wrong, or `folder` cannot be written.
    """
    options = options or Options()
    source_folder(source, WHAT)
    remarks: list[str] = []
    path = only_file([source / "calibration", source], ("*.toml", "*.qca.txt", "*.xcp"), f"one calibration, {WHAT}", is_calibration)
    rig = _rig(source, path, options, remarks.append)
    session, more = assemble_upright(rig, folder.resolve(), f"Pose2Sim project {source.resolve().name}", options, source / POSES)
    session, keypoint_remarks = with_imported_keypoints(session, options, source / POSES, (options.unit or "m") if path.suffix == ".toml" else None)
    return saved(session), [*remarks, *more, *keypoint_remarks]


def _rig(source: Path, path: Path, options: Options, note: Callable[[str], None]) -> Rig:
    if path.suffix == ".toml":
        unit_m = metres_per_unit(options.unit or "m", "")
        if not options.unit:
            note("The calibration is assumed to be in metres, as Pose2Sim writes it; give --unit if it is not.")
        up = up_axis(options.up, WHY_UP)
        return Rig(path, read_calibration_toml(path, unit_m, note), source, up)
    laboratory = LABORATORIES[path.suffix]
    if options.unit not in (None, "mm"):
        raise input_error("--unit", options.unit or "", f"mm, the unit of {laboratory.maker}'s calibrations", "leave the option out")
    return Rig(path, laboratory.read(path, note), source, up_axis(options.up or laboratory.up, ""))
