"""A person's tubes: their rings, the garment on each ring, how they follow a motion's bones, and their colours.

Skin, hair and patterned cloth give each triangle one colour: reflectances of blue, green, red.
"""

from collections.abc import Mapping
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bayes_body.workshop.simulation import person_shape as shape
from bayes_body.workshop.simulation.person_shape import (
    HAIR,
    LONG_SLEEVE,
    SHIRT,
    SHOES,
    SHORT_SLEEVE,
    SKIN,
    TOP,
    TROUSER_LEG,
    TROUSERS,
    Build,
    Cut,
    Outfit,
    Row,
    worn,
)
from bayes_body.workshop.simulation.surface import ANGLES


class Tube(NamedTuple):
    """The rings of one tube.

    Attributes:
        name: `l_leg`, `trunk` and so on.
        stations: (ring,), measured in bones.
        garment: (ring,), what covers each ring.
        sides: (ring, 4), half widths to the left, to the right, ahead, behind; metres.
        roundness: (ring,), the superellipse's exponent.
        room_m: (ring,), how far the cloth can move relative to the limb; 0 for skin.
        blend_m: (joint,), the distance from each joint within which the path bends.
        length_m: (bone,), usual lengths, for distances along the tube.
    """

    name: str
    stations: Float[np.ndarray, " ring"]
    garment: Int[np.ndarray, " ring"]
    sides: Float[np.ndarray, "ring 4"]
    roundness: Float[np.ndarray, " ring"]
    room_m: Float[np.ndarray, " ring"]
    blend_m: Float[np.ndarray, " joint"]
    length_m: Float[np.ndarray, " bone"]

    @property
    def distance_m(self) -> Float[np.ndarray, " ring"]:
        """The usual distance of each ring along the tube."""
        knots = np.concatenate([[0.0], np.cumsum(self.length_m)])
        return np.interp(self.stations, np.arange(len(knots)), knots)


class Plan(NamedTuple):
    """How to build a kind of tube: its table, its cloth, the blends at the joints and the usual lengths of the bones."""

    table: tuple[Row, ...]
    cuts: Mapping[int, tuple[Cut, float]]
    blend_m: tuple[float, ...]
    length_m: tuple[float, ...]


# A stretch of stations that one garment covers, and its number of rings.
type Stretch = tuple[int, float, float, int]


def tubes(build: Build, outfit: Outfit) -> list[Tube]:
    """All tubes of a person."""
    sleeve = SHORT_SLEEVE if outfit.top == "short" else LONG_SLEEVE
    arm = Plan(shape.ARM, {SHIRT: (sleeve, outfit.top_fit)}, (0.05, 0.045, 0.02), (0.14, 0.30, 0.26, 0.185))
    leg = Plan(shape.LEG, {TROUSERS: (TROUSER_LEG, outfit.leg_fit)}, (0.07, 0.065), (0.06, 0.42, 0.41))
    trunk = Plan(shape.TRUNK, {SHIRT: (TOP, outfit.top_fit), TROUSERS: ((TOP[0], TOP[0]), 0.0)}, (0.2,), (0.36, 0.39))
    head, foot = Plan(shape.HEAD, {}, (0.04,), (0.235, 0.09)), Plan(shape.FOOT, {}, (), (0.28,))
    thumb = Plan(shape.THUMB, {}, (), (0.09,))
    parts = [_tube("trunk", trunk, _trunk_stretches(), build), _tube("head", head, [(HAIR, 0.0, 1.04, 15), (SKIN, 1.15, 1.9, 4)], build)]
    for side in ("l", "r"):
        parts += [_tube(f"{side}_leg", leg, _leg_stretches(outfit), build), _tube(f"{side}_arm", arm, _arm_stretches(outfit), build)]
        parts += [_tube(f"{side}_foot", foot, [(SHOES, 0.0, 1.0, 12)], build), _tube(f"{side}_thumb", thumb, [(SKIN, 0.0, 1.0, 5)], build)]
    return parts


def _trunk_stretches() -> list[Stretch]:
    return [(SHIRT, 0.05, 1.72, 20), (TROUSERS, 1.72, 2.0, 4)]


def _leg_stretches(outfit: Outfit) -> list[Stretch]:
    if outfit.legs == "long":
        return [(TROUSERS, 0.1, 0.7, 2), (TROUSERS, 1.05, 2.95, 21), (SKIN, 2.95, 3.0, 2)]
    return [(TROUSERS, 0.1, 0.7, 2), (TROUSERS, 1.05, 1.82, 9), (SKIN, 1.82, 3.0, 12)]


def _arm_stretches(outfit: Outfit) -> list[Stretch]:
    hand: list[Stretch] = [(SKIN, 3.1, 4.0, 8)]
    if outfit.top == "long":
        return [(SHIRT, 0.1, 0.7, 3), (SHIRT, 0.9, 2.97, 18), (SKIN, 2.97, 3.0, 1), *hand]
    return [(SHIRT, 0.1, 0.7, 3), (SHIRT, 0.9, 1.52, 7), (SKIN, 1.52, 3.0, 13), *hand]


def _tube(name: str, plan: Plan, stretches: list[Stretch], build: Build) -> Tube:
    stations = np.concatenate([np.linspace(start, end, count) for _, start, end, count in stretches])
    garment = np.concatenate([np.full(count, material) for material, _, _, count in stretches])
    skin, roundness = shape.sides(plan.table, stations)
    skin = skin * _girth(name, build, stations)
    cloth = skin.copy()
    for material, (cut, fit) in plan.cuts.items():
        chosen = garment == material
        cloth[chosen] = worn(skin[chosen], stations[chosen], cut, fit)
    room = 0.8 * np.minimum((cloth - skin).mean(axis=1), 0.03) * np.isin(garment, tuple(plan.cuts))
    if name == "trunk":
        # The shirt hangs freely from the chest downwards; trousers sit on the hips.
        room = room * np.clip((stations - 0.6) / 1.0, 0.0, 1.0) * (garment == SHIRT)
    elif name.endswith("leg"):
        room = room * np.clip((stations - 1.0) / 0.5, 0.0, 1.0)
    elif name.endswith("arm"):
        room = room * np.clip((stations - 0.8) / 0.4, 0.0, 1.0)
    cloth = cloth * build.scale
    if name.startswith("r_"):
        cloth = cloth[:, [1, 0, 2, 3]]
    return Tube(name, stations, garment, cloth, roundness, room * build.scale, np.array(plan.blend_m), np.array(plan.length_m) * build.scale)


def _girth(name: str, build: Build, stations: Float[np.ndarray, " ring"]) -> Float[np.ndarray, "ring #side"]:
    if name == "trunk":
        factor = np.repeat(shape.trunk_factor(build, stations), 4, axis=1)
        factor[:, 2] += build.belly_m / 0.11 * np.exp(-(((stations - 1.25) / 0.35) ** 2))
        return factor
    if name.endswith(("leg", "arm")):
        # Wrists, hands and ankles vary little in girth.
        return 1.0 + (build.limbs - 1.0) * np.interp(stations, [1.0, 2.0, 2.6, 3.0], [1.0, 1.0, 0.7, 0.3])[:, None]
    return np.ones((len(stations), 1))


type Colour = tuple[float, float, float]

SKINS: tuple[Colour, ...] = ((0.52, 0.62, 0.84), (0.42, 0.54, 0.78), (0.30, 0.42, 0.64), (0.19, 0.27, 0.45), (0.12, 0.17, 0.30))
HAIRS: tuple[Colour, ...] = ((0.04, 0.05, 0.06), (0.06, 0.10, 0.16), (0.12, 0.22, 0.34), (0.30, 0.50, 0.66), (0.50, 0.52, 0.54))
TOPS: tuple[Colour, ...] = (
    *((0.16, 0.14, 0.62), (0.55, 0.30, 0.12), (0.20, 0.45, 0.18), (0.75, 0.76, 0.76), (0.10, 0.10, 0.11)),
    *((0.20, 0.62, 0.80), (0.55, 0.50, 0.20), (0.40, 0.18, 0.36), (0.45, 0.46, 0.48)),
)
LEGS: tuple[Colour, ...] = ((0.38, 0.24, 0.15), (0.10, 0.10, 0.10), (0.24, 0.36, 0.46), (0.30, 0.30, 0.31), (0.18, 0.13, 0.11), (0.55, 0.62, 0.66))
SHOE: tuple[Colour, ...] = ((0.07, 0.07, 0.08), (0.75, 0.75, 0.76), (0.10, 0.18, 0.30), (0.16, 0.14, 0.50))
EYES: Colour = (0.15, 0.14, 0.16)
# Standard deviation of the weave's brightness.
GRAIN = 0.03
LIPS = np.array([0.75, 0.68, 1.0])
# The face on the head's tube: angles on either side of the front.
FRONT = ANGLES // 4

type Pattern = Literal["plain", "stripes", "plaid", "mottled"]


class Palette(NamedTuple):
    """A person's colours.

    Attributes:
        skin: colour of face and limbs.
        hair: colour of the hair.
        top: the two colours of the T-shirt or jumper.
        pattern: how they alternate.
        legs: colour of the trousers.
        shoes: colour of the shoes.
        long_hair: whether the hair reaches the neck.
    """

    skin: Colour
    hair: Colour
    top: tuple[Colour, Colour]
    pattern: Pattern
    legs: Colour
    shoes: Colour
    long_hair: bool


def palette(random: np.random.Generator, long_hair: bool) -> Palette:
    """Random colours."""
    first, second = random.choice(len(TOPS), 2, replace=False)
    pattern: Pattern = ("plain", "stripes", "plaid", "mottled")[random.integers(4)]
    skin, hair, legs, shoes = (options[random.integers(len(options))] for options in (SKINS, HAIRS, LEGS, SHOE))
    return Palette(skin, hair, (TOPS[first], TOPS[second]), pattern, legs, shoes, long_hair)


def colours(tubes: list[Tube], places: Int[np.ndarray, "face 2"], chosen: Palette, random: np.random.Generator) -> Float[np.ndarray, "face 3"]:
    """The colour of each triangle.

    Args:
        tubes: in the order of their rings.
        places: (face, 2), ring and angle of each triangle.
        chosen: the person's colours.
        random: for the weave.
    """
    table = _garments(tubes, chosen)
    first = 0
    for tube in tubes:
        part = table[first : first + len(tube.stations)]
        if tube.name == "head":
            _paint_head(part, tube.stations, chosen)
        part *= np.where((tube.garment == SHIRT)[:, None, None], _woven(tube, chosen, random), 1.0)
        first += len(tube.stations)
    grain = 1.0 + GRAIN * random.standard_normal((*table.shape[:2], 1))
    return np.clip((table * grain)[places[:, 0], places[:, 1]], 0.01, 1.0)


def _garments(tubes: list[Tube], chosen: Palette) -> Float[np.ndarray, "ring angle 3"]:
    plain = np.zeros((5, 3))
    for garment, colour in ((SKIN, chosen.skin), (SHIRT, chosen.top[0]), (TROUSERS, chosen.legs), (SHOES, chosen.shoes), (HAIR, chosen.skin)):
        plain[garment] = colour
    return np.repeat(plain[np.concatenate([tube.garment for tube in tubes])][:, None], ANGLES, axis=1)


def _woven(tube: Tube, chosen: Palette, random: np.random.Generator) -> Float[np.ndarray, "ring angle 3"]:
    """Factors that change the top's first colour into its pattern."""
    distance, angles = tube.distance_m[:, None], 2.0 * np.pi * np.arange(ANGLES) / ANGLES
    bands, posts = np.sin(2.0 * np.pi * distance / 0.11) > 0.1, np.sin(5.0 * angles) > 0.2
    amount = {
        "plain": np.zeros((len(distance), ANGLES)),
        "stripes": np.broadcast_to(bands, (len(distance), ANGLES)).astype(float),
        "plaid": 0.5 * bands + 0.5 * posts,
        "mottled": np.clip(0.4 + 0.35 * random.standard_normal((len(distance), ANGLES)), 0.0, 1.0),
    }[chosen.pattern]
    ratio = np.array(chosen.top[1]) / np.array(chosen.top[0])
    return 1.0 + amount[..., None] * (ratio - 1.0)


def hairy(stations: Float[np.ndarray, " ring"], long_hair: bool) -> Float[np.ndarray, "ring angle"]:
    """Where hair grows on the head's tube: 1 or 0. Each value belongs to the face between two neighbouring angles."""
    off = np.abs((np.arange(ANGLES) + 0.5 - FRONT + ANGLES / 2) % ANGLES - ANGLES / 2) / (ANGLES / 2)
    # Hair reaches the forehead in front, the ears at the sides and the nape behind.
    nape = 1.3 if long_hair else 0.78
    side = 1.1 if long_hair else 0.44
    low = np.interp(off, [0.0, 0.3, 0.42, 0.55, 0.7, 1.0], [0.20, 0.24, 0.42, side, nape, nape])
    return (stations[:, None] < low).astype(float)


def _paint_head(table: Float[np.ndarray, "ring angle 3"], stations: Float[np.ndarray, " ring"], chosen: Palette) -> None:
    table[hairy(stations, chosen.long_hair) > 0] = chosen.hair
    eyes, mouth, brows = (int(np.argmin(np.abs(stations - station))) for station in (0.50, 0.79, 0.43))
    table[eyes, [FRONT - 2, FRONT + 1]] = EYES
    table[brows, [FRONT - 2, FRONT + 1]] = (np.array(chosen.hair) + np.array(chosen.skin)) / 2
    table[mouth, [FRONT - 1, FRONT]] *= LIPS
