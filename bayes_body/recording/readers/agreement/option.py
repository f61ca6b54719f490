"""The changes of a calibration that a user asks for: `--rig inverted` for all cameras, `--rig cam02=turned_180` for one. None is made unasked."""

from collections.abc import Mapping, Sequence

from bayes_body.base.errors import InputError, input_error, nearest
from bayes_body.recording.readers.agreement.changes import ANGLES, CHANGES, Size, scaled, turned
from bayes_body.recording.readers.calibration.calibrated import Calibrated
from bayes_body.recording.readers.faults import Faults
from bayes_body.recording.readers.sources import is_scaled

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
    turns = camera.quarter_turns
    for name in (changes.get(""), changes.get(camera.name)):
        if name == SCALED:
            camera = _scaled(camera, size_px)
        elif name is not None and name != AS_GIVEN:
            change = CHANGES[name]
            # A calibration that does not state the size of its pictures belongs to those that the change leads from.
            camera = Calibrated.from_spec(change.apply(camera.spec(camera.size_px or change.calibrated_size(size_px))))
    return camera._replace(quarter_turns=turns)


def upright(camera: Calibrated, changes: Changes, size_px: Size) -> Calibrated:
    """Return the camera after the quarter turns that its file states, if the pictures were turned: their size tells, if it can.

    Pictures that are square, or turned by 180°, have the same size before and after: the file is believed, unless the user asks for `as_given`.

    Args:
        camera: as its file has it.
        changes: that the user asks for.
        size_px: of its pictures.
    """
    turns, stated_px = camera.quarter_turns, camera.size_px
    camera = camera._replace(quarter_turns=0)
    is_unturned = turns % 2 == 1 and stated_px is not None and stated_px[0] != stated_px[1] and stated_px == size_px
    if turns == 0 or stated_px is None or is_unturned or is_as_given(changes, camera.name):
        return camera
    return Calibrated.from_spec(turned(camera.spec(stated_px), turns))._replace(quarter_turns=turns)


def describe_turns(cameras: Sequence[Calibrated]) -> list[str]:
    """Return a sentence on the cameras that were turned because their file states it."""
    by_turn: dict[int, list[str]] = {}
    for camera in cameras:
        if camera.quarter_turns:
            by_turn.setdefault(camera.quarter_turns, []).append(camera.name)
    return [
        f"rotation_count: the calibration of {', '.join(names)} was turned by {ANGLES[turns]} with the pictures; "
        f"if they were not turned, give --rig {AS_GIVEN}."
        for turns, names in by_turn.items()
    ]


def _scaled(camera: Calibrated, size_px: Size) -> Calibrated:
    subject = f"--rig {camera.name}={SCALED}"
    if camera.size_px is None:
        raise input_error(subject, "its calibration does not state the size of its pictures", "half_size or double_size", "name one of them")
    if not is_scaled(camera.size_px, size_px):
        shape = f"{camera.size_px[0]} x {camera.size_px[1]}"
        raise input_error(subject, f"pictures of {size_px[0]} x {size_px[1]}", f"the shape of {shape}, as in its calibration", "calibrate again")
    return Calibrated.from_spec(scaled(camera.spec(camera.size_px), size_px))


def option(changes: Changes) -> str:
    """Return changes as a user writes them."""
    return " ".join(f"--rig {f'{camera}={name}' if camera else name}" for camera, name in changes.items())


def describe_changes(changes: Changes) -> list[str]:
    """Return a sentence on each change."""
    return [f"--rig {f'{camera}={name}' if camera else name}: {_describe(name)}." for camera, name in changes.items()]


def _describe(name: str) -> str:
    if name == AS_GIVEN:
        return "the calibration stays as it is, whatever the keypoints say"
    if name == SCALED:
        return "the calibration was scaled to the size of the pictures"
    return f"the calibration was changed, since {CHANGES[name].meaning}"
