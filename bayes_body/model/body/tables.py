"""The tables of a body file (models/bodies/*.toml, or `[body]` in a model): joints, their angles and limits, parts, markers.

Metres and degrees, as the user writes them. `bayes_body.model.body.build` converts them to arrays in metres and radians.
"""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from bayes_body.base.toml.schema import Finite, Name, Positive, Schema

Preset = Literal["x90", "x180", "x270", "y90", "y180", "y270", "z90", "z180", "z270"]
Direction = Literal["x", "y", "z", "-x", "-y", "-z"]
Axis = Literal[Direction, "tx", "ty", "tz", "width"]
# Segments between which joint angles are defined (bayes_body/results/clinical/conventions.py).
LIMB_SEGMENTS = ("thigh", "shank", "talus", "foot", "upper_arm", "forearm", "hand")
SEGMENTS = ("pelvis", "thorax", "head", *(f"{side}_{name}" for side in "rl" for name in LIMB_SEGMENTS))


class Dof(Schema):
    """One degree of freedom: a rotation about (`x`, `-x`, ...) or a translation along (`tx`, ...) an axis of the joint's own frame, or a `width`.

    A rotation has limits in degrees, a translation in metres; without limits it is unbounded. With equal limits it is fixed, and no longer a dof. A
    width moves nothing: it is added, in metres, to the radii of the parts whose `widened` names it, and must have limits.
    """

    name: Name
    axis: Axis
    low_deg: Finite | None = None
    high_deg: Finite | None = None
    low_m: Finite | None = None
    high_m: Finite | None = None

    @property
    def is_shift(self) -> bool:
        """Whether this is a length (metres) rather than an angle (radians)."""
        return self.axis.startswith("t") or self.is_width

    @property
    def is_width(self) -> bool:
        """Whether this changes radii and moves nothing."""
        return self.axis == "width"

    @property
    def limits(self) -> tuple[float | None, float | None]:
        """The limits as written: degrees for an angle, metres for a translation or a width."""
        return (self.low_m, self.high_m) if self.is_shift else (self.low_deg, self.high_deg)

    @property
    def is_fixed(self) -> bool:
        """Whether its limits allow one value only."""
        low, high = self.limits
        return low is not None and low == high

    @model_validator(mode="after")
    def _check_limits(self) -> "Dof":
        unit, wrong_unit = ("m", "deg") if self.is_shift else ("deg", "m")
        if getattr(self, f"low_{wrong_unit}") is not None or getattr(self, f"high_{wrong_unit}") is not None:
            kind = "a shift" if self.is_shift else "an angle"
            raise ValueError(f"dof '{self.name}' is {kind}: give its limits as low_{unit} and high_{unit}")
        low, high = self.limits
        if (low is None) != (high is None):
            raise ValueError(f"dof '{self.name}' has only one limit: give both low_{unit} and high_{unit}, or neither")
        if low is not None and high is not None and low > high:
            raise ValueError(f"dof '{self.name}': low_{unit} = {low:g} is above high_{unit} = {high:g}; swap them, or make them equal if it is fixed")
        return self


class Offset(Schema):
    """A vector along the axes of a frame. Each entry is in metres or the name of a length, with an optional sign: `z = "-torso"`."""

    x: Finite | str = 0.0
    y: Finite | str = 0.0
    z: Finite | str = 0.0


class Joint(Schema):
    """A frame attached to its parent: translated along the parent's axes, rotated by the presets in order, then moved by its dofs in order."""

    name: Name
    parent: str
    preset: tuple[Preset, ...] = ()
    offset: Offset = Offset()
    dofs: tuple[Dof, ...] = ()


class Part(Schema):
    """A tapered cylinder with an elliptical section along +z of its frame, or a sphere about the point at half its length.

    Radii and length are in metres, or fractions of the body's height for subjects without their own measurements. `widened` names the dofs of axis
    `width` that are added to the radii of base and tip; an empty name means none.
    """

    name: Name
    joint: str
    kind: Literal["cylinder", "sphere"] = "cylinder"
    preset: tuple[Preset, ...] = ()
    offset: Offset = Offset()
    length: str
    radius_of_height: tuple[Positive, Positive]
    section: tuple[Positive, Positive] = (1.0, 1.0)
    widened: tuple[str, str] = ("", "")


class Marker(Schema):
    """A virtual marker: a point in a joint's frame."""

    joint: str
    offset: Offset = Offset()


class Segment(Schema):
    """The anatomical axes of a segment: which axes of a joint's frame point forward and up in a person who stands upright with hanging arms.

    The palms face forward. The third axis points to the person's right.
    """

    joint: str
    forward: Direction
    up: Direction


class BodyTables(Schema):
    """All tables of a body file; `BodySchema` also checks that their names fit together."""

    title: str
    source: str
    height_m: Positive = 1.75
    measured_as: str | None = None
    lengths_of_height: dict[str, Positive]
    joints: Annotated[tuple[Joint, ...], Field(min_length=1, alias="joint")]
    parts: Annotated[tuple[Part, ...], Field(min_length=1, alias="part")]
    markers: dict[Name, Marker] = {}
    clinical: dict[Name, Segment] = {}
    penetration: tuple[tuple[str, str], ...] = ()
    spheres_per_part: Annotated[int, Field(ge=2, le=20)] = 4
