"""A person's tubes: their rings, the garment on each ring, and how they follow a motion's bones."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bayes_body.workshop.simulation import person_shape as shape
from bayes_body.workshop.simulation.clothes import HAIR, LONG_SLEEVE, SHIRT, SHOES, SHORT_SLEEVE, SKIN, TOP, TROUSER_LEG, TROUSERS, Cut, Outfit, worn
from bayes_body.workshop.simulation.person_shape import Build, Row


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
    garment = np.concatenate([np.full(count, what) for what, _, _, count in stretches])
    skin, roundness = shape.sides(plan.table, stations)
    skin = skin * _girth(name, build, stations)
    cloth = skin.copy()
    for what, (cut, fit) in plan.cuts.items():
        chosen = garment == what
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
