"""A project of Pose2Sim as a session: `calibration/*.toml` or `*.qca.txt`, `videos/NAME.mp4` for each camera, `pose/NAME_json` with its keypoints."""

from pathlib import Path

from bayes_body.errors import input_error
from bayes_body.recording import calibration_qualisys
from bayes_body.recording.assemble import Rig, assemble, only_file, saved, source_folder
from bayes_body.recording.calibration_toml import read_calibration_toml
from bayes_body.recording.imported_keypoints import with_imported_keypoints
from bayes_body.recording.options import Options, metres_per_unit, up_axis
from bayes_body.session.session import Session

WHAT = "a project of Pose2Sim (calibration, videos, pose)"
WHY_UP = "Pose2Sim's toml does not say which axis of its world points up (that depends on how the scene was calibrated)"


def import_pose2sim(source: Path, folder: Path, options: Options | None = None) -> tuple[Session, list[str]]:
    """Write the session of a Pose2Sim project; its files stay where they are.

    A toml is in metres, as Pose2Sim writes it, unless the options name another unit; the axis that points up must be given with it.

    Args:
        source: the project's folder.
        folder: where `session.toml` is to lie; made if need be.
        options: what the user said.

    Returns:
        The session as saved, and remarks for the user, a sentence each.

    Raises:
        FaultyFileError: one sentence for each thing in the source that is missing or wrong.
        InputError: `source` is no folder, an option is missing or wrong, or `folder` cannot be written.
    """
    options = options or Options()
    source_folder(source, WHAT)
    path = only_file([source / "calibration", source], ("*.toml", "*.qca.txt"), f"one calibration, {WHAT}")
    rig, remarks = _rig(source, path, options)
    session, more = assemble(rig, folder.resolve(), f"Pose2Sim project {source.resolve().name}", options)
    session, told = with_imported_keypoints(session, options, source / "pose")
    return saved(session), [*remarks, *more, *told]


def _rig(source: Path, path: Path, options: Options) -> tuple[Rig, list[str]]:
    if path.suffix == ".toml":
        unit_m = metres_per_unit(options.unit or "m", "")
        remarks = [] if options.unit else ["The calibration is taken to be in metres, as Pose2Sim writes it; say --unit if it is not."]
        up = up_axis(options.up, WHY_UP)
        return Rig(path, read_calibration_toml(path, unit_m), source, up), remarks
    if options.unit not in (None, "mm"):
        raise input_error("--unit", options.unit or "", "mm, the unit of Qualisys's calibrations", "leave the option out")
    up = up_axis(options.up or calibration_qualisys.UP, "")
    return Rig(path, calibration_qualisys.read_qualisys(path), source, up), []
