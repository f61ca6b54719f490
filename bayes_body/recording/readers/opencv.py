"""Import a folder with OpenCV's calibrations (yml, yaml, xml, json; EasyMocap's pair; or Anipose's toml) and recordings named after the cameras."""

from collections.abc import Sequence
from pathlib import Path

from bayes_body.base.errors import input_error
from bayes_body.recording.readers.agreement.turned_pictures import assemble_upright
from bayes_body.recording.readers.assemble import Rig, saved, source_folder
from bayes_body.recording.readers.calibration.calibrated import Calibrated
from bayes_body.recording.readers.calibration.opencv import SUFFIXES, read_opencv
from bayes_body.recording.readers.calibration.toml import read_calibration_toml
from bayes_body.recording.readers.keypoints.imported import with_imported_keypoints
from bayes_body.recording.readers.options import Options, metres_per_unit, up_axis
from bayes_body.recording.session.session import Session

WHAT = "a folder with a calibration file (yml, yaml, xml, json, or one toml of Anipose) and a recording of each camera"
WHY_UNIT = "these files do not say the unit of their translations"
WHY_UP = "these files do not say which axis of their world points up"


def import_opencv(source: Path, folder: Path, options: Options | None = None) -> tuple[Session, list[str]]:
    """Write the session of cameras calibrated with OpenCV. Their files stay where they are. The options must give the unit and the up axis.

    Args:
        source: holds the calibration files, directly or in `calibration`, and the recordings, directly or in `videos` or `images`.
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
    unit_m, up = metres_per_unit(options.unit, WHY_UNIT), up_axis(options.up, WHY_UP)
    path, notes = _calibration([source / "calibration", source]), list[str]()
    cameras: Sequence[Calibrated] = read_calibration_toml(path, unit_m, notes.append) if path.suffix == ".toml" else read_opencv(path, unit_m)
    session, remarks = assemble_upright(Rig(path, cameras, source, up), folder.resolve(), f"recording {source.resolve().name}", options)
    session, keypoint_remarks = with_imported_keypoints(session, options, unit=options.unit)
    return saved(session), [*notes, *remarks, *keypoint_remarks]


def _calibration(places: Sequence[Path]) -> Path:
    """The folder of OpenCV's files, or Anipose's toml."""
    for place in (place for place in places if place.is_dir()):
        files = sorted(path for path in place.iterdir() if path.suffix.lower() in SUFFIXES)
        tomls = sorted(place.glob("*.toml"))
        if len(tomls) > 1 or (files and tomls):
            names = ", ".join(path.name for path in (*tomls, *files))
            raise input_error(place, f"calibrations of two rigs or programs ({names})", WHAT, "keep only those of one program there")
        if files or tomls:
            return place if files else tomls[0]
        if xcps := sorted(place.glob("*.xcp")):
            raise input_error(xcps[0], "Vicon's calibration", WHAT, "import it by `bayes-body import vicon`")
    raise input_error(places[-1], "no calibration in it", WHAT, "name the folder that holds the calibrations and recordings")
