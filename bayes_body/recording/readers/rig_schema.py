"""The schema of a rig's TOML file: cameras in metres, pixels and degrees; each has a position and a target, or extrinsics, or a path."""

import re
from collections import Counter
from collections.abc import Iterator
from itertools import pairwise
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from bayes_body.base.toml.schema import Finite, NonNegative, Positive, Schema
from bayes_body.recording.session.lens import lens_faults
from bayes_body.recording.session.schema import Far, Rotation, Size

type Point = tuple[Far, Far, Far]
# Two points nearer than this (metres) give no direction. A view closer to the vertical than this (sine) has no horizontal axis.
LEAST_DISTANCE_M, LEAST_SINE = 1e-3, 1e-3
# Camera names become file names on any system.
FILE_NAME = re.compile(r"\w[\w .+%-]*")


def file_name(text: str) -> str:
    """The camera's name, if it is a valid file name.

    Raises:
        ValueError: it is not; the message is a sentence without its subject.
    """
    if not FILE_NAME.fullmatch(text):
        raise ValueError(f'"{text}"; expected letters, digits, _ or -, since it becomes a file name; rename the camera')
    return text


def _double(value: Any) -> Any:
    """Accept one focal length for both x and y."""
    return (value, value) if isinstance(value, int | float) and not isinstance(value, bool) else value


def direction_faults(position: "Point | None", look_at: "Point | None") -> Iterator[str]:
    """Why two points (metres) do not define a viewing direction with a horizontal axis, as sentences without their subject."""
    if position is None or look_at is None:
        return
    direction = np.subtract(look_at, position)
    distance = float(np.linalg.norm(direction))
    if distance < LEAST_DISTANCE_M:
        yield "look_at_m is where the camera stands; expected two different points; move one of them"
    elif np.linalg.norm(direction[:2]) < LEAST_SINE * distance:
        yield "looks straight up or down; expected a view with a horizontal axis; move look_at_m aside, or give rotation and translation_m"


class KeyframeTable(Schema):
    """`[[camera.path]]`: the pose of a moving camera at one time."""

    time_s: NonNegative
    position_m: Point
    look_at_m: Point
    roll_deg: Finite = 0.0

    @model_validator(mode="after")
    def _check_direction(self) -> "KeyframeTable":
        for sentence in direction_faults(self.position_m, self.look_at_m):
            raise ValueError(sentence)
        return self


class RigCameraTable(Schema):
    """`[[camera]]`: one camera. Exactly one of these is given: position_m and look_at_m, rotation and translation_m, or a path."""

    name: Annotated[str, Field(min_length=1), AfterValidator(file_name)]
    size_px: Size
    focal_px: Annotated[tuple[Positive, Positive], BeforeValidator(_double)]
    centre_px: tuple[Finite, Finite] | None = None
    skew: Finite = 0.0
    distortion: tuple[Finite, Finite, Finite, Finite, Finite] = (0.0, 0.0, 0.0, 0.0, 0.0)
    position_m: Point | None = None
    look_at_m: Point | None = None
    roll_deg: Finite = 0.0
    grey: Annotated[bool, Field(strict=True)] = False
    rotation: Rotation | None = None
    translation_m: Point | None = None
    path: tuple[KeyframeTable, ...] = ()

    @model_validator(mode="after")
    def _check_place(self) -> "RigCameraTable":
        sentences = [*self._place_faults(), *self._lens_faults(), *direction_faults(self.position_m, self.look_at_m), *self._path_faults()]
        if sentences:
            raise ValueError("\n".join(sentences))
        return self

    def _place_faults(self) -> Iterator[str]:
        pairs = (("position_m", "look_at_m"), ("rotation", "translation_m"))
        stated_pairs = [[name for name in pair if getattr(self, name) is not None] for pair in pairs]
        for pair, names in zip(pairs, stated_pairs, strict=True):
            if len(names) == 1:
                (missing,) = set(pair) - set(names)
                yield f"{names[0]} without {missing}; expected both; add {missing}"
        ways = sum(bool(names) for names in stated_pairs) + bool(self.path)
        if ways != 1:
            problem = "no place" if ways == 0 else f"{ways} places"
            yield f"{problem}; expected position_m and look_at_m, rotation and translation_m, or [[camera.path]]; give one of the three"

    def _lens_faults(self) -> Iterator[str]:
        centre = self.centre_px or (self.size_px[0] / 2, self.size_px[1] / 2)
        for field, problem, expected in lens_faults(self.size_px, self.focal_px, centre, self.distortion):
            yield f"{field}: {problem}; expected {expected}; copy it from the calibration again"

    def _path_faults(self) -> Iterator[str]:
        if len(self.path) == 1:
            yield "path has 1 keyframe; expected 2 or more; add one, or give position_m and look_at_m"
        for earlier, later_keyframe in pairwise(self.path):
            if later_keyframe.time_s <= earlier.time_s:
                yield f"path goes from {earlier.time_s:g} s to {later_keyframe.time_s:g} s; expected ascending times; put the keyframes in order"


class RigFile(Schema):
    """The whole file."""

    title: str
    fps: Positive
    up: Literal["z"] = "z"
    cameras: Annotated[tuple[RigCameraTable, ...], Field(alias="camera", min_length=1)]

    @model_validator(mode="after")
    def _check_names(self) -> "RigFile":
        # File names that differ only in case are the same file on some systems.
        counts = Counter(camera.name.lower() for camera in self.cameras)
        repeated = [camera.name for camera in self.cameras if counts[camera.name.lower()] > 1]
        if repeated:
            raise ValueError(
                f"camera '{repeated[0]}': {counts[repeated[0].lower()]} cameras have this name; expected unique names; rename all but one."
            )
        return self
