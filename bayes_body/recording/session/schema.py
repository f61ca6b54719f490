"""The schema of `session.toml`: metres, pixels and degrees, as a person writes them. `read.py` converts degrees to radians."""

import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, model_validator

from bayes_body.base.errors import nearest
from bayes_body.base.toml.schema import Count, Finite, Name, NonNegative, Positive, ProperShare, Schema, Share
from bayes_body.recording.session.lens import lens_faults

# A larger number is assumed to be in millimetres (or centimetres), not in metres.
FARTHEST_M = 1000.0
LONGEST_M = 3.0
# Largest accepted distance of a rotation from orthonormal. Calibration files have six digits or more.
ROTATION_TOLERANCE = 1e-4
# A standard deviation above this is a unit that was mistaken, or nothing known: the model of a small turn does not hold there.
WIDEST_DEG, LONGEST_S = 20.0, 1.0
# A keypoint farther beside its joint belongs to another one.
FARTHEST_OFFSET_M = 0.5
# Exactly one printf conversion of a whole number (%d, %04d), of at most 99 digits; %% is a literal percent sign.
PATTERN = re.compile(r"([^%]|%%)*%0?\d{0,2}d([^%]|%%)*")
# Four hours at 60 frames per second. The files of every frame are looked for before a run.
MOST_FRAMES = 1_000_000
LARGEST_NUMBER = 10**9
MOST_CAMERAS = 1000
# A side of an image, and an image, pixels (`bayes_body` gives OpenCV the same limit).
LONGEST_SIDE, MOST_PIXELS = 65_535, 2**27
# Frames from which a background is learned are all in memory.
MOST_LEARNING_FRAMES = 1000


def rotation_fault(R: NDArray[np.float64]) -> str | None:
    """Why a (3, 3) matrix is not a rotation, as the middle of a sentence; None if it is one."""
    with np.errstate(over="ignore", invalid="ignore"):
        off = float(np.linalg.norm(R @ R.T - np.eye(3)))
    if not off <= ROTATION_TOLERANCE:
        return f"not a rotation, R R^T is {off:.2g} away from the identity; expected orthonormal rows; copy R again with at least six digits"
    if np.linalg.det(R) < 0:
        return "a reflection, det R = -1; expected a rotation, det R = 1; flip the sign of the mirrored axis in the calibration"
    return None


def _rotation(rows: "Rows") -> "Rows":
    fault = rotation_fault(np.array(rows))
    if fault:
        raise ValueError(fault)
    return rows


def _metres(limit: float) -> AfterValidator:
    def check(value: float) -> float:
        if abs(value) > limit:
            raise ValueError(f"{value:g}; expected metres, at most {limit:g}; it looks like millimetres, divide by 1000")
        return value

    return AfterValidator(check)


def _pattern(text: str) -> str:
    if not PATTERN.fullmatch(text):
        raise ValueError(f'"{text}"; expected one placeholder for the frame number; write %d or %04d, as in "CAM1/image%04d.bmp"')
    return text


def _size(sides: tuple[int, int]) -> tuple[int, int]:
    if sides[0] * sides[1] > MOST_PIXELS:
        raise ValueError(f"{sides[0]} x {sides[1]} pixels; expected at most {MOST_PIXELS} in all; correct it to the size of the images")
    return sides


Frames = Annotated[Count, Field(le=MOST_FRAMES)]
Side = Annotated[Count, Field(le=LONGEST_SIDE)]
Size = Annotated[tuple[Side, Side], AfterValidator(_size)]
FilePath = Annotated[Name, Field(min_length=1)]
Far = Annotated[Finite, _metres(FARTHEST_M)]
Beside = Annotated[Finite, _metres(FARTHEST_OFFSET_M)]
BesideSd = Annotated[NonNegative, _metres(FARTHEST_OFFSET_M)]
Turn = Annotated[Positive, Field(le=WIDEST_DEG)]
Delay = Annotated[Finite, Field(ge=-LONGEST_S, le=LONGEST_S)]
Length = Annotated[Positive, _metres(LONGEST_M)]
Pattern = Annotated[Name, AfterValidator(_pattern)]
Number = Annotated[int, Field(strict=True, ge=0, le=LARGEST_NUMBER)]
SpanRow = tuple[Number, Number, Annotated[Count, Field(le=MOST_FRAMES)]]
type Row = tuple[Finite, Finite, Finite]
type Rows = tuple[Row, Row, Row]
Rotation = Annotated[Rows, AfterValidator(_rotation)]


class CameraTable(Schema):
    """`[[camera]]`: one calibrated camera and the location of its images."""

    name: Annotated[Name, Field(min_length=1)]
    size_px: Size
    focal_px: tuple[Positive, Positive]
    centre_px: tuple[Finite, Finite]
    skew: Finite = 0.0
    distortion: tuple[Finite, Finite, Finite, Finite, Finite] = (0.0, 0.0, 0.0, 0.0, 0.0)
    rotation: Rotation
    translation_m: tuple[Far, Far, Far]
    images: Pattern | None = None
    video: FilePath | None = None
    video_fps: Positive | None = None
    masks: Pattern | None = None
    background: FilePath | None = None
    offset: Annotated[int, Field(strict=True, ge=-LARGEST_NUMBER, le=LARGEST_NUMBER)] = 0
    keypoints: FilePath | None = None
    path: FilePath | None = None
    spans: tuple[SpanRow, ...] = ()
    turn_sd_deg: tuple[Turn, Turn, Turn] | None = None
    move_sd_m: tuple[Length, Length, Length] | None = None
    focal_sd: ProperShare | None = None
    centre_sd_px: tuple[Positive, Positive] | None = None
    delay_s: Delay = 0.0
    delay_sd_s: Annotated[Positive, Field(le=LONGEST_S)] | None = None

    @model_validator(mode="after")
    def _check_spans(self) -> "CameraTable":
        if self.spans and self.video is None:
            raise ValueError("spans: a camera without a video; expected the runs of a video's frames; remove spans")
        for (instant, frame, count), following in pairwise(self.spans):
            if following[0] < instant + count or following[1] < frame + count:
                problem = f"[{instant}, {frame}, {count}] reaches into {list(following)}"
                raise ValueError(f"spans: {problem}; expected [instant, frame, count], ascending; import the videos again")
        return self

    @model_validator(mode="after")
    def _check_lens(self) -> "CameraTable":
        faults = lens_faults(self.size_px, self.focal_px, self.centre_px, self.distortion)
        if sentences := [f"{field}: {problem}; expected {expected}; copy it from the calibration again" for field, problem, expected in faults]:
            raise ValueError("\n".join(sentences))
        return self


class SubjectTable(Schema):
    """`[subject]`: what is known about the person."""

    body: str | None = None
    height_m: Length | None = None
    lengths_m: dict[str, Length] = {}
    radii_m: dict[str, tuple[Length, Length]] = {}
    outline_radii_m: dict[str, tuple[Length, Length]] = {}
    sections: dict[str, tuple[Positive, Positive]] = {}
    motion_sd_deg: dict[str, Positive] = {}
    motion_sd_m: dict[str, Length] = {}
    lengths_sd: dict[str, ProperShare] = {}
    keypoint_offsets_m: dict[str, tuple[Beside, Beside, Beside]] = {}
    keypoint_offsets_sd_m: dict[str, tuple[BesideSd, BesideSd, BesideSd]] = {}


class InitialTable(Schema):
    """`[initial]`: what is known about the first pose: dofs of a body, markers in the world, or keypoints in the images."""

    angles_deg: dict[str, Finite] = {}
    positions_m: dict[str, Far] = {}
    markers_m: dict[str, tuple[Far, Far, Far]] = {}
    keypoints_px: dict[str, dict[str, tuple[Finite, Finite, Share]]] = {}
    fit_lengths: Annotated[bool, Field(strict=True)] = False
    fit_outline: Annotated[bool, Field(strict=True)] = False


class SegmentationTable(Schema):
    """`[segmentation]`: how silhouettes are found if there are no masks, and which of their figures can be the subject's."""

    threshold: Positive = 16.0
    learning_frames: Annotated[Count, Field(le=MOST_LEARNING_FRAMES)] = 200
    shadows: Annotated[bool, Field(strict=True)] = True
    follow_exposure: Annotated[bool, Field(strict=True)] = True
    figures: Literal["all", "near_body"] = "all"


class SessionFile(Schema):
    """The whole file."""

    title: str
    up: Literal["x", "y", "z"]
    fps: Positive
    frames: Frames
    first_frame: Annotated[int, Field(strict=True, ge=0, le=LARGEST_NUMBER)] = 0
    cameras: Annotated[tuple[CameraTable, ...], Field(alias="camera", min_length=1, max_length=MOST_CAMERAS)]
    subject: SubjectTable = SubjectTable()
    initial: InitialTable = InitialTable()
    segmentation: SegmentationTable = SegmentationTable()
    truth: FilePath | None = None
    recorded: tuple[Annotated[int, Field(strict=True, ge=0, le=LARGEST_NUMBER)], Frames] | None = None
    calibration: FilePath | None = None

    @property
    def positions(self) -> frozenset[str]:
        """Names of the dofs that the file gives in metres."""
        return frozenset(self.subject.motion_sd_m) | frozenset(self.initial.positions_m)

    @model_validator(mode="after")
    def _check_whole(self) -> "SessionFile":
        sentences = [*self._range(), *self._duplicate_names(), *self._first_delay(), *self._sources(), *self._incomplete_masks(), *self._ambiguous()]
        sentences += self._unknown_cameras()
        if sentences:
            raise ValueError("\n".join(sentences))
        return self

    def _duplicate_names(self) -> Iterator[str]:
        for name, count in Counter(camera.name for camera in self.cameras).items():
            if count > 1:
                yield f"camera '{name}': {count} cameras have this name; expected unique names; rename all but one."

    def _first_delay(self) -> Iterator[str]:
        """Delays count against the first camera."""
        first = self.cameras[0]
        if first.delay_s or first.delay_sd_s:
            yield f"camera '{first.name}'.delay_s: the first camera's clock is the recording's; expected no delay; remove delay_s and delay_sd_s."

    def _range(self) -> Iterator[str]:
        """A range of frames lies within the recording."""
        if self.recorded is None:
            return
        start, count = self.recorded
        last, end = self.first_frame + self.frames - 1, start + count - 1
        if not start <= self.first_frame <= last <= end:
            problem = f"frames {start} to {end}, and the session has {self.first_frame} to {last}"
            yield f"recorded: {problem}; expected frames of the recording; correct first_frame and frames, or remove recorded."

    def _sources(self) -> Iterator[str]:
        for camera in self.cameras:
            if (camera.images is None) == (camera.video is None):
                problem = "neither images nor video" if camera.images is None else "both images and video"
                yield f"camera '{camera.name}': {problem}; expected one of the two; give the pattern of its image files or the path of its video."
            first = min([self.first_frame, *(self.recorded or ())[:1]])
            if first + camera.offset < 0:
                problem = f"{camera.offset}, so its frames would begin at number {first + camera.offset}"
                yield f"camera '{camera.name}'.offset: {problem}; expected 0 or later; raise first_frame, and lower frames by the same amount."

    def _unknown_cameras(self) -> Iterator[str]:
        names = [camera.name for camera in self.cameras]
        for name in self.initial.keypoints_px:
            if name not in names:
                yield f"initial.keypoints_px.{name}: no camera of that name; {nearest(name, names)}"

    def _incomplete_masks(self) -> Iterator[str]:
        if any(camera.masks for camera in self.cameras):
            for camera in self.cameras:
                if not camera.masks:
                    yield f"camera '{camera.name}'.masks: missing, others have masks; expected all or none; add it, or remove the others."

    def _ambiguous(self) -> Iterator[str]:
        angles = frozenset(self.subject.motion_sd_deg) | frozenset(self.initial.angles_deg)
        for name in sorted(angles & self.positions):
            yield f"'{name}': given both in degrees and in metres; expected an angle or a position; remove one."


def to_radians(degrees: Mapping[str, float]) -> dict[str, float]:
    """The values in radians."""
    return {name: math.radians(value) for name, value in degrees.items()}
