"""The changes of a calibration that a user asks for: `--rig inverted` for all cameras, `--rig cam02=turned_180` for one. None is made unasked."""

from collections.abc import Mapping, Sequence

from bayes_body.base.errors import InputError, input_error, nearest
from bayes_body.recording.readers.calibration import Calibrated
from bayes_body.recording.readers.faults import Faults
from bayes_body.recording.readers.rig_changes import CHANGES, Size, scaled

# The calibration stays as it is, even if the keypoints contradict it.
AS_GIVEN = "as_given"
# The calibration is scaled to the size of the pictures.
SCALED = "scaled"
NAMES = (AS_GIVEN, *CHANGES, SCALED)

# The name of a change by camera, under an empty name for all cameras.
type Changes = Mapping[str, str]


def check_changes(changes: Changes, cameras: Sequence[str]) -> None:
    """Refuse changes and cameras that do not exist.

    Raises:
        FaultyFileError: one sentence for each.
    """
    faults = Faults()
    for camera, change in changes.items():
        with faults.collect():
            if camera and camera not in cameras:
                raise InputError(f"--rig: '{camera}': no such camera; {nearest(camera, cameras)}")
        with faults.collect():
            if change not in NAMES:
                raise InputError(f"--rig: '{change}': no such change of a calibration; {nearest(change, NAMES)}")
    faults.raise_any()


def is_as_given(changes: Changes, camera: str) -> bool:
    """Return whether a camera's calibration stays as the file has it."""
    return changes.get(camera, changes.get("")) == AS_GIVEN


def changed(camera: Calibrated, changes: Changes, size_px: Size) -> Calibrated:
    """Return the camera with the changes of all cameras and its own.

    Args:
        camera: as its file has it.
        changes: that the user asks for.
        size_px: of its pictures.

    Raises:
        InputError: the pictures have another shape than those of the calibration, so that it cannot be scaled.
    """
    for name in (changes.get(""), changes.get(camera.name)):
        if name == SCALED:
            camera = _scaled(camera, size_px)
        elif name in CHANGES:
            change = CHANGES[name]
            # A calibration that does not state the size of its pictures belongs to those that the change leads from.
            camera = Calibrated.from_spec(change.apply(camera.spec(camera.size_px or change.calibrated_size(size_px))))
    return camera


def _scaled(camera: Calibrated, size_px: Size) -> Calibrated:
    subject = f"--rig {camera.name}={SCALED}"
    if camera.size_px is None:
        raise input_error(subject, "its calibration does not state the size of its pictures", "half_size or double_size", "name one of them")
    if not is_scaled(camera.size_px, size_px):
        shape = f"{camera.size_px[0]} x {camera.size_px[1]}"
        raise input_error(subject, f"pictures of {size_px[0]} x {size_px[1]}", f"the shape of {shape}, as in its calibration", "calibrate again")
    return Calibrated.from_spec(scaled(camera.spec(camera.size_px), size_px))


def is_scaled(calibrated_px: Size, size_px: Size) -> bool:
    """Return whether pictures have the shape of those of the calibration, up to half a pixel, and another size."""
    factor = size_px[0] / calibrated_px[0]
    return size_px != calibrated_px and abs(size_px[1] - factor * calibrated_px[1]) <= 0.5


def describe_changes(changes: Changes) -> list[str]:
    """Return a sentence on each change."""
    return [f"--rig {f'{camera}={name}' if camera else name}: {_describe(name)}." for camera, name in changes.items()]


def _describe(name: str) -> str:
    if name == AS_GIVEN:
        return "the calibration stays as it is, whatever the keypoints say"
    if name == SCALED:
        return "the calibration was scaled to the size of the pictures"
    return f"the calibration was changed, since {CHANGES[name].meaning}"
