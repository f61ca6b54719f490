"""The options of an import: units, up axis, additional files, the subject's height, offsets."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, cast

from bayes_body.base.errors import InputError, input_error, nearest
from bayes_body.recording.session.schema import LONGEST_M

type Axis = Literal["x", "y", "z"]
METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254}
# A height above this cannot be in centimetres.
LONGEST_CM = 300


@dataclass(frozen=True)
class Options:
    """The options of all importers. An importer refuses options that have no meaning for it.

    Attributes:
        unit: the unit of length of the calibration, `m`, `cm`, `mm` or `in` (inches).
        up: the world's axis that points up.
        fps: frames per second; overrides the videos' own rate.
        height_m: the subject's stature.
        masks: a folder that contains a folder of numbered silhouettes for each camera.
        background: a folder that contains an image or a video of the empty scene for each camera.
        truth: an .npz with true markers.
        offsets: the session's frame k is the camera's frame k + offset.
        layout: the order of the keypoints, a name in `keypoints.LAYOUTS`.
        keypoints: a folder that contains for each camera a folder of OpenPose's files, or a file of AlphaPose, MMPose, DeepLabCut or SLEAP.
        first_frame: number of the first frame that is imported, as in the file names; in a video they count from 0.
        frames: number of frames that are imported; all from the first one on by default.
        measures_lengths: whether the lengths of the limbs are measured on the keypoints of two or more cameras.
        progress: whether bars on standard error show what takes long.
        resample: whether videos of different rates are paired by time, at the slowest rate.
        keypoints_first: of a camera, or of all cameras under an empty name: the number of the keypoints of the first recorded frame.
        rig: the change of a camera's calibration, or of all cameras' under an empty name (`agreement.option.NAMES`).
        videos: the folder with the recordings, if it is not the usual one.
        keypoints_unit: the unit of the keypoints, `px` or `share` (of the image's width and height); pixels by default.
    """

    unit: str | None = None
    up: str | None = None
    fps: float | None = None
    height_m: float | None = None
    masks: Path | None = None
    background: Path | None = None
    truth: Path | None = None
    offsets: Mapping[str, int] = field(default_factory=dict)
    layout: str | None = None
    keypoints: Path | None = None
    first_frame: int | None = None
    frames: int | None = None
    measures_lengths: bool = True
    keypoints_first: Mapping[str, int] = field(default_factory=dict)
    rig: Mapping[str, str] = field(default_factory=dict)
    resample: bool = False
    progress: bool = False
    keypoints_unit: str | None = None
    videos: Path | None = None


def check_height(height_m: float | None) -> None:
    """Refuse a height that is not in metres.

    Raises:
        InputError: it is not above 0, or above 3.
    """
    if height_m is not None and not 0 < height_m <= LONGEST_M:
        unit, factor = ("centimetres", 100) if height_m <= LONGEST_CM else ("millimetres", 1000)
        remedy = f"it looks like {unit}, divide by {factor}" if height_m > 10 * LONGEST_M else "give the stature in metres"
        raise input_error("--height", f"{height_m:g}", f"metres, above 0 and at most {LONGEST_M:g}", remedy)


def check_fps(fps: float | None) -> None:
    """Refuse an invalid frame rate.

    Raises:
        InputError: it is not finite and above 0.
    """
    if fps is not None and not 0 < fps < 1e6:
        raise input_error("--fps", f"{fps:g}", "frames per second, above 0", "give the rate at which the cameras filmed")


def metres_per_unit(unit: str | None, why: str) -> float:
    """Metres per unit that the user names.

    Args:
        unit: `m`, `cm`, `mm`, `in`, or None if it was not given.
        why: why it must be given, as the beginning of a sentence.

    Raises:
        InputError: not given, or no such unit.
    """
    if unit is None:
        raise input_error("--unit", f"not given; {why}", "m, cm, mm or in", "give the unit of its translations, such as --unit mm")
    if unit not in METRES:
        raise InputError(f"--unit: '{unit}': no such unit; {nearest(unit, METRES)}")
    return METRES[unit]


def up_axis(up: str | None, why: str) -> Axis:
    """The axis of the world that points up, as the user names it.

    Args:
        up: `x`, `y`, `z`, or None if it was not given.
        why: why it must be given, as the beginning of a sentence.

    Raises:
        InputError: not given, or no such axis.
    """
    if up is None:
        raise input_error("--up", f"not given; {why}", "x, y or z", "give the axis of its world that points up, such as --up z")
    if up not in ("x", "y", "z"):
        raise input_error("--up", f"'{up}'", "x, y or z", "name the axis that points up; if one points down, rotate the calibration")
    return cast(Axis, up)
