"""The simulator's person: a clothed body around the joints of a motion.

Nothing here uses the model's body. Sections, heads, hands, shoes and cloth are defined in this package only, so that the model is not tested against
itself.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from bayes_body.base.errors import input_error
from bayes_body.workshop.simulation.person_bones import Chain, chains
from bayes_body.workshop.simulation.person_motion import Landmarks, complete
from bayes_body.workshop.simulation.person_parts import FRONT, Tube, colours, hairy, palette, tubes
from bayes_body.workshop.simulation.person_shape import HAIR, SHIRT, TROUSERS, Build, Folds, Outfit, folded, hanging
from bayes_body.workshop.simulation.surface import ANGLES, COSINES, SINES, Mesh, Rings, sections, sweep, triangles

type Shape = Literal["man", "woman"]

SHORTEST_M, TALLEST_M = 0.8, 2.3
# Mean and standard deviation of the stature (ANSUR 1988).
STATURES: dict[Shape, tuple[float, float]] = {"man": (1.76, 0.067), "woman": (1.63, 0.064)}
# Distance from a joint within which its bend has an effect, metres.
FELT_M = 0.09
FLOOR_M = 0.002


@dataclass(frozen=True, eq=False)
class Person:
    """The person to be filmed.

    Attributes:
        build: body measurements.
        outfit: clothes.
        tubes: the parts of the body.
        outline: (2, ring, angle), the rings' points in their planes, metres.
        folds: folds of cloth and skin.
        faces: (face, 3), the same in every frame.
        colours: (face, 3), reflectances of blue, green, red.
    """

    build: Build
    outfit: Outfit
    tubes: tuple[Tube, ...]
    outline: Float[np.ndarray, "2 ring angle"]
    folds: Folds
    faces: Int[np.ndarray, "face 3"]
    colours: Float[np.ndarray, "face 3"]

    def perform(self, landmarks: Landmarks, fps: float = 60.0) -> "Performance":
        """The person in a motion, with all frames prepared: bones, and where the clothes hang.

        Args:
            landmarks: the fifteen markers (joint centres, the head's crown) over time, and where known toes, finger ends and neck; metres, z up,
                floor at 0.
            fps: frames per second.

        Raises:
            InputError: a marker is missing or unknown in all frames.
        """
        complete_landmarks = complete(landmarks)
        bones = chains(complete_landmarks, self.build.height_m, fps)
        parts = [sweep(bones[tube.name], tube.stations, tube.blend_m * self.build.scale) for tube in self.tubes]
        rings = Rings(*(np.concatenate(arrays, axis=1) for arrays in zip(*parts, strict=True)))
        room = np.concatenate([tube.room_m for tube in self.tubes])
        bend = np.concatenate([_bends(tube, bones) for tube in self.tubes], axis=1)
        return Performance(self, hanging(rings, room, self.outfit.stiffness_hz, fps), bend)

    def mesh(self, landmarks: Landmarks, frame: int, fps: float = 60.0) -> Mesh:
        """The person in one frame of a motion. For several frames, call `perform` once."""
        return self.perform(landmarks, fps).mesh(frame)


@dataclass(frozen=True, eq=False)
class Performance:
    """A person in a motion.

    Attributes:
        person: the person.
        rings: the body's rings over time.
        bend: (frame, ring), the bend of the nearest joint, radians.
    """

    person: Person
    rings: Rings
    bend: Float[np.ndarray, "frame ring"]

    def __len__(self) -> int:
        """The number of frames."""
        return len(self.bend)

    def mesh(self, frame: int) -> Mesh:
        """The surface in one frame."""
        person = self.person
        heights, swelling = folded(person.folds, self.bend[frame])
        x, y = person.outline * swelling
        x, y = x + heights * COSINES, y + heights * SINES
        centres, tangent, lateral = (part[frame] for part in self.rings)
        forward = np.cross(tangent, lateral)
        points = centres[:, None] + x[..., None] * lateral[:, None] + y[..., None] * forward[:, None]
        vertices = np.concatenate([points.reshape(-1, 3), points[_ends(person.tubes)].mean(axis=1)])
        vertices[:, 2] = np.maximum(vertices[:, 2], FLOOR_M)
        return Mesh(vertices, person.faces, person.colours)


def build_person(seed: int, height_m: float | None = None, shape: Shape | None = None) -> Person:
    """Build a person. The same arguments give the same person.

    Args:
        seed: determines girth, clothes and colours.
        height_m: stature; None: random.
        shape: a man's or a woman's proportions; None: random.

    Raises:
        InputError: an impossible stature.
    """
    if height_m is not None and not SHORTEST_M <= height_m <= TALLEST_M:
        raise input_error("the subject's height", f"{height_m:g} m", f"{SHORTEST_M:g} to {TALLEST_M:g} m", "give it in metres")
    random = np.random.default_rng([seed, 1])
    drawn = ("man", "woman")[int(random.integers(2))]
    shape = shape or drawn
    mean, deviation = STATURES[shape]
    stature = float(mean + deviation * np.clip(random.standard_normal(), -2.0, 2.0))
    build = _build(random, shape, stature if height_m is None else height_m)
    outfit = _outfit(random)
    long_hair = bool(random.random() < (0.75 if shape == "woman" else 0.08))
    parts = tubes(build, outfit)
    faces, places = triangles([len(tube.stations) for tube in parts])
    painted = colours(parts, places, palette(random, long_hair), random)
    outline = np.concatenate([_outline(tube, build, long_hair) for tube in parts], axis=1)
    return Person(build, outfit, tuple(parts), outline, _folds(parts, outfit, random), faces, painted)


def _build(random: np.random.Generator, shape: Shape, height_m: float) -> Build:
    stout, muscular = np.clip(random.standard_normal(2), -1.8, 1.8)
    limbs, chest, waist = 1.0 + 0.045 * stout + 0.03 * muscular, 1.0 + 0.04 * stout + 0.03 * muscular, 1.0 + 0.08 * stout
    belly = 0.012 + 0.02 * max(stout, 0.0)
    if shape == "man":
        return Build(height_m, limbs, chest, waist, 1.0 + 0.04 * stout, belly)
    return Build(height_m, 0.97 * limbs, 0.92 * chest, 0.92 * waist, 1.04 + 0.045 * stout, 0.6 * belly, 0.028 + 0.008 * stout)


def _outfit(random: np.random.Generator) -> Outfit:
    top = "long" if random.random() < 0.4 else "short"
    legs = "short" if random.random() < 0.15 else "long"
    return Outfit(top, legs, float(random.uniform(0.94, 1.06)), float(random.uniform(0.9, 1.1)), float(random.uniform(2.6, 3.8)))


def _outline(tube: Tube, build: Build, long_hair: bool) -> Float[np.ndarray, "2 ring angle"]:
    """A tube's rings in their planes, with details that are not superellipses: nose, ears, hair, bust."""
    x, y = sections(tube.sides, tube.roundness)
    if tube.name == "head":
        y[:, FRONT] += 0.028 * build.scale * np.interp(tube.stations, [0.46, 0.63, 0.69], [0.0, 1.0, 0.0], left=0.0, right=0.0)
        for ear in (0, ANGLES // 2):
            x[:, ear] *= 1.0 + 0.22 * np.interp(tube.stations, [0.42, 0.50, 0.62, 0.70], [0.0, 1.0, 0.8, 0.0])
        faces = hairy(tube.stations, long_hair)
        hair = (0.024 if long_hair else 0.013) * build.scale * np.minimum(faces, np.roll(faces, 1, axis=1))
        x, y = x + hair * COSINES, y + hair * SINES
    elif tube.name == "trunk":
        indices = np.arange(ANGLES)
        bumps = sum(np.exp(-(((indices - FRONT - side) / 1.3) ** 2)) for side in (-1.8, 1.8))
        y = y + build.bust_m * build.scale * np.exp(-(((tube.stations - 0.66) / 0.16) ** 2))[:, None] * bumps
    return np.stack([x, y])


def _folds(parts: list[Tube], outfit: Outfit, random: np.random.Generator) -> Folds:
    phase, fixed, growing, swelling = [], [], [], []
    angles = 2.0 * np.pi * np.arange(ANGLES) / ANGLES
    for tube in parts:
        cloth = np.isin(tube.garment, (SHIRT, TROUSERS))[:, None]
        loose = cloth * np.clip(tube.room_m / 0.008, 0.3, 1.0)[:, None]
        distance = tube.distance_m[:, None]
        turns = random.uniform(0.0, 2.0 * np.pi, 5)
        wander = 1.2 * np.sin(angles + turns[0]) + 0.8 * np.sin(2.0 * angles + turns[1] + 5.0 * distance)
        phase.append(2.0 * np.pi * distance / 0.085 + wander)
        lengthwise = np.sin(4.0 * angles + turns[2] + 3.0 * np.sin(6.0 * distance + turns[3]))
        fixed.append(outfit.folds_m * loose * (0.4 * lengthwise + 0.4 * np.sin(2.0 * np.pi * distance / 0.12 + wander + turns[4])))
        growing.append(outfit.folds_m * loose)
        swelling.append(_swelling(tube))
        if tube.name == "head":
            hair = (tube.garment == HAIR)[:, None] * np.clip(tube.stations[:, None] / 0.2, 0.0, 1.0)
            fixed[-1] = hair * 0.0015 * random.standard_normal((len(distance), ANGLES))
    return Folds(*(np.concatenate(arrays) for arrays in (phase, fixed, growing, swelling)))


def _swelling(tube: Tube) -> Float[np.ndarray, "ring angle"]:
    """Bent knees swell in front and bent elbows behind, because the path's parabola cuts their corners; a lifted thigh pushes the shirt."""
    if tube.name == "trunk":
        return 0.35 * np.maximum(SINES, 0.0) * np.ones((len(tube.stations), 1))
    side = {"leg": SINES, "arm": -SINES}.get(tube.name[2:])
    if side is None:
        return np.zeros((len(tube.stations), ANGLES))
    nearness = np.exp(-(((tube.stations - 2.0) / 0.12) ** 2))[:, None]
    return 0.09 * nearness * np.maximum(side, 0.0)


def _bends(tube: Tube, bones: Mapping[str, Chain]) -> Float[np.ndarray, "frame ring"]:
    """The bend at each ring: that of its own joints, or that of the hips where a shirt hangs over them."""
    if tube.name != "trunk":
        return bones[tube.name].bend @ _felt(tube).T
    hips = np.maximum(bones["l_leg"].bend[:, 0], bones["r_leg"].bend[:, 0])
    return hips[:, None] * np.clip((tube.stations - 1.3) / 0.4, 0.0, 1.0)


def _felt(tube: Tube) -> Float[np.ndarray, "ring joint"]:
    """The weight of each joint's bend at each ring."""
    joints = np.cumsum(tube.length_m)[:-1]
    return np.exp(-(((tube.distance_m[:, None] - joints) / FELT_M) ** 2))


def _ends(parts: tuple[Tube, ...]) -> Int[np.ndarray, " end"]:
    """The first and the last ring of each tube."""
    stops = np.cumsum([len(tube.stations) for tube in parts])
    return np.stack([stops - [len(tube.stations) for tube in parts], stops - 1], axis=1).ravel()
