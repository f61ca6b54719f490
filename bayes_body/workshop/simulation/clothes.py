r"""A person's clothes: sections outside the limbs' sections, and cloth that lags behind the limbs.

Cloth on a limb is a mass on a damped spring, subject to gravity and to the limb's own acceleration $a$, both perpendicular to the limb only:
$\ddot x = (g - a) - 2 \zeta \omega \dot x - \omega^2 x$. Its displacement is limited by the room r: $d = r \tanh(|x| / r)\,x / |x|$.
Folds are waves around the limb that grow and move with the bend of the nearest joint.
"""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.signal import bilinear, lfilter, lfilter_zi

from bayes_body.workshop.simulation.person_motion import unit
from bayes_body.workshop.simulation.surface import Rings

SKIN, SHIRT, TROUSERS, SHOES, HAIR = range(5)
GRAVITY = np.array([0.0, 0.0, -9.81])
DAMPING = 0.3
# Least distance between cloth and skin.
THICKNESS_M = 0.006

type Cut = tuple[tuple[float, float, float, float, float], ...]
# Like the tables in person_shape: station, half widths outwards, inwards, ahead, behind, of the cloth as cut. Wider skin stretches it.
TROUSER_LEG: Cut = (
    (0.0, 0.05, 0.05, 0.05, 0.06),
    (1.0, 0.092, 0.086, 0.092, 0.104),
    (1.2, 0.098, 0.088, 0.096, 0.108),
    (1.5, 0.092, 0.084, 0.092, 0.090),
    (2.0, 0.080, 0.076, 0.080, 0.078),
    (2.5, 0.075, 0.072, 0.073, 0.080),
    (3.0, 0.074, 0.070, 0.074, 0.080),
)
SHORT_SLEEVE: Cut = (
    (0.0, 0.035, 0.085, 0.056, 0.066),
    (1.0, 0.058, 0.066, 0.066, 0.066),
    (1.3, 0.063, 0.066, 0.070, 0.068),
    (1.6, 0.068, 0.068, 0.070, 0.068),
)
LONG_SLEEVE: Cut = (
    (0.0, 0.035, 0.085, 0.056, 0.066),
    (1.0, 0.058, 0.066, 0.066, 0.066),
    (1.5, 0.060, 0.060, 0.066, 0.064),
    (2.0, 0.058, 0.056, 0.056, 0.058),
    (2.6, 0.050, 0.050, 0.050, 0.050),
    (3.0, 0.038, 0.038, 0.040, 0.040),
)
TOP: Cut = (
    (0.0, 0.07, 0.07, 0.06, 0.07),
    (0.4, 0.168, 0.168, 0.118, 0.116),
    (0.8, 0.176, 0.176, 0.140, 0.122),
    (1.3, 0.178, 0.178, 0.140, 0.128),
    (1.72, 0.202, 0.202, 0.148, 0.154),
)


class Outfit(NamedTuple):
    """The clothes of a person.

    Attributes:
        top: the sleeves of a T-shirt or a jumper.
        legs: the length of the trousers.
        top_fit: scale factor of the top's cut; below 1 it is tight.
        leg_fit: scale factor of the trousers' cut.
        stiffness_hz: frequency at which the cloth swings.
        folds_m: height of the folds.
    """

    top: Literal["short", "long"] = "short"
    legs: Literal["short", "long"] = "long"
    top_fit: float = 1.0
    leg_fit: float = 1.0
    stiffness_hz: float = 3.2
    folds_m: float = 0.006


def worn(skin: Float[np.ndarray, "ring 4"], stations: Float[np.ndarray, " ring"], cut: Cut, fit: float) -> Float[np.ndarray, "ring 4"]:
    """Half widths of the cloth over the skin."""
    rows = np.array(cut)
    widths = np.stack([np.interp(stations, rows[:, 0], rows[:, column]) for column in range(1, 5)], axis=1)
    return np.maximum(skin + THICKNESS_M, fit * widths)


def hanging(rings: Rings, room_m: Float[np.ndarray, " ring"], stiffness_hz: float, fps: float) -> Rings:
    """The rings, with those of cloth moved to where the cloth hangs.

    Args:
        rings: rings around the limbs.
        room_m: how far cloth may move; 0 for skin.
        stiffness_hz: frequency of the spring.
        fps: frames per second.
    """
    loose = np.flatnonzero(room_m > 0)
    if not len(loose):
        return rings
    centres, along = rings.centres[:, loose], rings.along[:, loose]
    felt = GRAVITY - _acceleration(centres, fps)
    felt = felt - np.sum(felt * along, axis=-1, keepdims=True) * along
    lag = _spring(felt, stiffness_hz, fps)
    far = np.linalg.norm(lag, axis=-1, keepdims=True)
    room = room_m[loose][:, None]
    moved = rings.centres.copy()
    moved[:, loose] += room * np.tanh(far / room) * unit(lag)
    return rings._replace(centres=moved)


def _acceleration(points: Float[np.ndarray, "frame ring 3"], fps: float) -> Float[np.ndarray, "frame ring 3"]:
    if len(points) < 3:
        return np.zeros_like(points)
    return np.gradient(np.gradient(points, axis=0), axis=0) * fps**2


def _spring(felt: Float[np.ndarray, "frame ring 3"], stiffness_hz: float, fps: float) -> Float[np.ndarray, "frame ring 3"]:
    """The response of the spring, which starts at rest under the first frame's force."""
    omega = 2.0 * np.pi * stiffness_hz
    b, a = bilinear([1.0], [1.0, 2.0 * DAMPING * omega, omega**2], fps)
    start = lfilter_zi(b, a)[:, None, None] * felt[:1]
    return lfilter(b, a, felt, axis=0, zi=start)[0]


class Folds(NamedTuple):
    """Waves on the cloth, as changes of the distance between a point and its ring's centre.

    Attributes:
        phase: (ring, angle), radians.
        fixed_m: (ring, angle), height on a straight limb.
        growing_m: (ring, 1), height per radian of bend.
        swelling: (ring, angle), relative growth of the outer side of a joint per radian of bend.
    """

    phase: Float[np.ndarray, "ring angle"]
    fixed_m: Float[np.ndarray, "ring angle"]
    growing_m: Float[np.ndarray, "ring 1"]
    swelling: Float[np.ndarray, "ring angle"]


def folded(folds: Folds, bend: Float[np.ndarray, " ring"]) -> tuple[Float[np.ndarray, "ring angle"], Float[np.ndarray, "ring angle"]]:
    """Heights of the folds, metres, and scale factors of the radii, for one frame's bends (radians)."""
    angle = bend[:, None]
    return folds.fixed_m + folds.growing_m * angle * np.sin(folds.phase + 2.0 * angle), 1.0 + folds.swelling * angle
