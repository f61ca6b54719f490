"""What `session.toml` may say: metres, pixels and degrees, as written by a person; `bayes_body.session.session` turns it into radians."""

import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, model_validator

from bayes_body.errors import nearest
from bayes_body.toml.schema import Count, Finite, Positive, Schema, Share

# Beyond these a number in metres is taken for one in millimetres (or centimetres).
FARTHEST_M = 1000.0
LONGEST_M = 3.0
# How far from orthonormal a rotation may be: calibration files are rounded to six digits or more.
ROTATION_TOLERANCE = 1e-4
# One printf conversion of a whole number (%d, %04d) and no other; %% is a literal percent sign.
PATTERN = re.compile(r"([^%]|%%)*%0?\d*d([^%]|%%)*")


def rotation_fault(R: NDArray[np.float64]) -> str | None:
    """What keeps a (3, 3) matrix from being a rotation, as the middle of a sentence; None for a rotation."""
    with np.errstate(over="ignore", invalid="ignore"):
        off = float(np.linalg.norm(R @ R.T - np.eye(3)))
    if not off <= ROTATION_TOLERANCE:
        return f"no rotation, R R^T is {off:.2g} away from the identity; expected orthonormal rows; copy R again with at least six digits"
    if np.linalg.det(R) < 0:
        return "a reflection, det R = -1; expected a rotation, det R = 1; flip the sign of the axis that the calibration mirrors"
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
        raise ValueError(f'"{text}"; expected one place for the frame\'s number; write it as %d or %04d, such as "CAM1/image%04d.bmp"')
    return text


Far = Annotated[Finite, _metres(FARTHEST_M)]
Length = Annotated[Positive, _metres(LONGEST_M)]
Pattern = Annotated[str, AfterValidator(_pattern)]
type Row = tuple[Finite, Finite, Finite]
type Rows = tuple[Row, Row, Row]


class CameraTable(Schema):
    """`[[camera]]`: one calibrated camera and where its images are."""

    name: Annotated[str, Field(min_length=1)]
    size_px: tuple[Count, Count]
    focal_px: tuple[Positive, Positive]
    centre_px: tuple[Finite, Finite]
    skew: Finite = 0.0
    distortion: tuple[Finite, Finite, Finite, Finite, Finite] = (0.0, 0.0, 0.0, 0.0, 0.0)
    rotation: Annotated[Rows, AfterValidator(_rotation)]
    translation_m: tuple[Far, Far, Far]
    images: Pattern | None = None
    video: Annotated[str, Field(min_length=1)] | None = None
    masks: Pattern | None = None
    background: Annotated[str, Field(min_length=1)] | None = None
    offset: Annotated[int, Field(strict=True)] = 0
    keypoints: Annotated[str, Field(min_length=1)] | None = None
    path: Annotated[str, Field(min_length=1)] | None = None


class SubjectTable(Schema):
    """`[subject]`: what is known of the person."""

    body: str | None = None
    height_m: Length | None = None
    lengths_m: dict[str, Length] = {}
    radii_m: dict[str, tuple[Length, Length]] = {}
    outline_radii_m: dict[str, tuple[Length, Length]] = {}
    sections: dict[str, tuple[Positive, Positive]] = {}
    motion_sd_deg: dict[str, Positive] = {}
    motion_sd_m: dict[str, Length] = {}


class InitialTable(Schema):
    """`[initial]`: the first pose as far as it is known: of a body's dofs, of markers in the world, or of keypoints in the images."""

    angles_deg: dict[str, Finite] = {}
    positions_m: dict[str, Far] = {}
    markers_m: dict[str, tuple[Far, Far, Far]] = {}
    keypoints_px: dict[str, dict[str, tuple[Finite, Finite, Share]]] = {}
    fit_lengths: Annotated[bool, Field(strict=True)] = False
    fit_outline: Annotated[bool, Field(strict=True)] = False


class SegmentationTable(Schema):
    """`[segmentation]`: how silhouettes are told from the background, where there are no masks."""

    threshold: Positive = 16.0
    learning_frames: Count = 200
    shadows: Annotated[bool, Field(strict=True)] = True
    follow_exposure: Annotated[bool, Field(strict=True)] = True


class SessionFile(Schema):
    """The whole file."""

    title: str
    up: Literal["x", "y", "z"]
    fps: Positive
    frames: Count
    first_frame: Annotated[int, Field(strict=True, ge=0)] = 0
    cameras: Annotated[tuple[CameraTable, ...], Field(alias="camera", min_length=1)]
    subject: SubjectTable = SubjectTable()
    initial: InitialTable = InitialTable()
    segmentation: SegmentationTable = SegmentationTable()
    truth: Annotated[str, Field(min_length=1)] | None = None

    @property
    def positions(self) -> frozenset[str]:
        """The dofs that the file gives in metres."""
        return frozenset(self.subject.motion_sd_m) | frozenset(self.initial.positions_m)

    @model_validator(mode="after")
    def _check_whole(self) -> "SessionFile":
        sentences = [*self._repeated(), *self._sources(), *self._half_masked(), *self._ambiguous(), *self._strangers()]
        if sentences:
            raise ValueError("\n".join(sentences))
        return self

    def _repeated(self) -> Iterator[str]:
        for name, count in Counter(camera.name for camera in self.cameras).items():
            if count > 1:
                yield f"camera '{name}': the name of {count} cameras; expected each name once; rename all but one."

    def _sources(self) -> Iterator[str]:
        for camera in self.cameras:
            if (camera.images is None) == (camera.video is None):
                found = "neither images nor video" if camera.images is None else "both images and video"
                yield f"camera '{camera.name}': {found}; expected one of the two; give the pattern of its image files or the path of its video."
            if self.first_frame + camera.offset < 0:
                found = f"{camera.offset}, its frames would begin at number {self.first_frame + camera.offset}"
                yield f"camera '{camera.name}'.offset: {found}; expected 0 or later; raise first_frame, and lower frames by as much."

    def _strangers(self) -> Iterator[str]:
        known = [camera.name for camera in self.cameras]
        for name in self.initial.keypoints_px:
            if name not in known:
                yield f"initial.keypoints_px.{name}: no camera of that name; {nearest(name, known)}"

    def _half_masked(self) -> Iterator[str]:
        if any(camera.masks for camera in self.cameras):
            for camera in self.cameras:
                if not camera.masks:
                    yield f"camera '{camera.name}'.masks: missing, others have masks; expected all or none; add it, or remove it from the others."

    def _ambiguous(self) -> Iterator[str]:
        angles = frozenset(self.subject.motion_sd_deg) | frozenset(self.initial.angles_deg)
        for name in sorted(angles & self.positions):
            yield f"'{name}': given both in degrees and in metres; expected an angle or a position; remove one."


def to_radians(degrees: Mapping[str, float]) -> dict[str, float]:
    """The values in radians."""
    return {name: math.radians(value) for name, value in degrees.items()}
