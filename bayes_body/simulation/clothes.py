r"""What a person wears: sections outside the limbs', and cloth that lags behind them.

Cloth hangs on a limb as a mass on a damped spring that feels gravity and the limb's own acceleration $a$, both only across the limb:
$\ddot x = (g - a) - 2 \zeta \omega \dot x - \omega^2 x$. It moves as far as it has room, $d = r \tanh(|x| / r)\,x / |x|$.
Folds are waves about the limb that grow and wander with the bend of the nearest joint.
"""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.signal import bilinear, lfilter, lfilter_zi

from bayes_body.simulation.person_motion import unit
from bayes_body.simulation.surface import Rings

SKIN, SHIRT, TROUSERS, SHOES, HAIR = range(5)
GRAVITY = np.array([0.0, 0.0, -9.81])
DAMPING = 0.3
# Cloth never comes nearer to the skin.
THICKNESS_M = 0.006

type Cut = tuple[tuple[float, float, float, float, float], ...]
# As in person_shape: station, half widths outwards, inwards, ahead, behind, of the cloth as it is cut; skin that is wider stretches it.
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
    """What is worn.

    Attributes:
        top: a T-shirt's or a jumper's sleeves.
        legs: how long the trousers are.
        top_fit: factor of the top's cut; below 1 it is tight.
        leg_fit: of the trousers'.
        stiffness_hz: frequency at which cloth swings.
        folds_m: height of the folds.
    """

    top: Literal["short", "long"] = "short"
    legs: Literal["short", "long"] = "long"
    top_fit: float = 1.0
    leg_fit: float = 1.0
    stiffness_hz: float = 3.2
    folds_m: float = 0.006


def worn(skin: Float[np.ndarray, "ring 4"], stations: Float[np.ndarray, " ring"], cut: Cut, fit: float) -> Float[np.ndarray, "ring 4"]:
    """Half widths of cloth over skin."""
    rows = np.array(cut)
    widths = np.stack([np.interp(stations, rows[:, 0], rows[:, column]) for column in range(1, 5)], axis=1)
    return np.maximum(skin + THICKNESS_M, fit * widths)


def hanging(rings: Rings, room_m: Float[np.ndarray, " ring"], stiffness_hz: float, fps: float) -> Rings:
    """The rings, those of cloth moved to where it hangs.

    Args:
        rings: about the limbs.
        room_m: how far cloth may move; 0 for skin.
        stiffness_hz: the spring's frequency.
        fps: frames a second.
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
    """The spring's answer, at rest under the first frame's pull."""
    omega = 2.0 * np.pi * stiffness_hz
    b, a = bilinear([1.0], [1.0, 2.0 * DAMPING * omega, omega**2], fps)
    start = lfilter_zi(b, a)[:, None, None] * felt[:1]
    return lfilter(b, a, felt, axis=0, zi=start)[0]


class Folds(NamedTuple):
    """Waves on the cloth, as changes of a point's distance from its ring's centre.

    Attributes:
        phase: (ring, angle), radians.
        fixed_m: (ring, angle), what is there on a straight limb.
        growing_m: (ring, 1), height for each radian of bend.
        swelling: (ring, angle), share by which a joint's outside stands out for each radian of bend.
    """

    phase: Float[np.ndarray, "ring angle"]
    fixed_m: Float[np.ndarray, "ring angle"]
    growing_m: Float[np.ndarray, "ring 1"]
    swelling: Float[np.ndarray, "ring angle"]


def folded(folds: Folds, bend: Float[np.ndarray, " ring"]) -> tuple[Float[np.ndarray, "ring angle"], Float[np.ndarray, "ring angle"]]:
    """Heights of the folds, metres, and factors of the radii, at a frame's bends (radians)."""
    angle = bend[:, None]
    return folds.fixed_m + folds.growing_m * angle * np.sin(folds.phase + 2.0 * angle), 1.0 + folds.swelling * angle
