r"""A person's measurements and clothes.

The measurements are half widths of the body's sections at selected stations, for a man of 1.75 m, in metres. Circumferences follow the US Army's
survey of 1988 (Gordon et al. 1989, ANSUR), medians of men: thigh 0.59, calf 0.38, ankle 0.22, chest 0.99, waist 0.86, hips 0.98, upper arm 0.33,
forearm 0.30, wrist 0.17, head 0.57, neck 0.38. A monotone cubic interpolates between the stations.

Clothes have sections outside the limbs' sections, and their cloth lags behind the limbs. Cloth on a limb is a mass on a damped spring, subject to
gravity and to the limb's own acceleration $a$, both perpendicular to the limb only:
$\ddot x = (g - a) - 2 \zeta \omega \dot x - \omega^2 x$. Its displacement is limited by the room r: $d = r \tanh(|x| / r)\,x / |x|$.
Folds are waves around the limb that grow and move with the bend of the nearest joint.
"""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator
from scipy.signal import bilinear, lfilter, lfilter_zi

from bayes_body.workshop.simulation.person_motion import unit
from bayes_body.workshop.simulation.surface import Rings

STATURE_M = 1.75

# A row: station in bones; half widths outwards, inwards, ahead and behind; roundness.
type Row = tuple[float, float, float, float, float, float]

# Bones: from inside the pelvis to the hip, thigh, shank.
LEG: tuple[Row, ...] = (
    (0.0, 0.060, 0.060, 0.070, 0.085, 2.0),
    (1.00, 0.082, 0.080, 0.085, 0.098, 2.1),
    (1.12, 0.090, 0.084, 0.088, 0.104, 2.1),
    (1.30, 0.088, 0.080, 0.088, 0.090, 2.2),
    (1.60, 0.076, 0.068, 0.080, 0.072, 2.2),
    (1.86, 0.060, 0.058, 0.065, 0.059, 2.2),
    (2.00, 0.056, 0.055, 0.062, 0.054, 2.3),
    (2.12, 0.053, 0.052, 0.053, 0.059, 2.2),
    (2.30, 0.056, 0.054, 0.046, 0.078, 2.1),
    (2.50, 0.049, 0.049, 0.043, 0.066, 2.1),
    (2.75, 0.036, 0.036, 0.037, 0.045, 2.1),
    (2.92, 0.033, 0.033, 0.037, 0.040, 2.1),
    (3.00, 0.036, 0.035, 0.040, 0.042, 2.1),
)
# Bones: from the side of the neck to the shoulder, upper arm, forearm, hand. Behind is the side away from the thumb.
ARM: tuple[Row, ...] = (
    (0.00, 0.030, 0.075, 0.050, 0.060, 2.0),
    (0.60, 0.044, 0.070, 0.066, 0.068, 2.1),
    (1.00, 0.052, 0.056, 0.060, 0.061, 2.1),
    (1.14, 0.054, 0.046, 0.056, 0.056, 2.1),
    (1.30, 0.048, 0.044, 0.052, 0.052, 2.1),
    (1.50, 0.044, 0.043, 0.054, 0.051, 2.1),
    (1.78, 0.040, 0.040, 0.044, 0.044, 2.1),
    (2.00, 0.043, 0.040, 0.038, 0.041, 2.1),
    (2.16, 0.047, 0.042, 0.043, 0.042, 2.1),
    (2.32, 0.045, 0.042, 0.043, 0.041, 2.1),
    (2.60, 0.034, 0.034, 0.037, 0.036, 2.1),
    (2.86, 0.024, 0.024, 0.031, 0.030, 2.2),
    (3.00, 0.020, 0.022, 0.030, 0.029, 2.3),
    (3.14, 0.020, 0.023, 0.036, 0.032, 2.4),
    (3.38, 0.016, 0.022, 0.043, 0.041, 2.6),
    (3.56, 0.012, 0.022, 0.042, 0.043, 2.6),
    (3.80, 0.004, 0.025, 0.036, 0.039, 2.5),
    (3.95, -0.002, 0.024, 0.026, 0.030, 2.3),
    (4.00, -0.008, 0.018, 0.010, 0.012, 2.0),
)
# Bones: from the base of the neck to the waist, from the waist to the crotch.
TRUNK: tuple[Row, ...] = (
    (0.00, 0.058, 0.058, 0.050, 0.062, 2.0),
    (0.10, 0.078, 0.078, 0.062, 0.078, 2.0),
    (0.22, 0.122, 0.122, 0.078, 0.092, 2.1),
    (0.36, 0.152, 0.152, 0.098, 0.102, 2.3),
    (0.52, 0.164, 0.164, 0.118, 0.108, 2.4),
    (0.72, 0.164, 0.164, 0.128, 0.106, 2.5),
    (0.90, 0.156, 0.156, 0.122, 0.100, 2.5),
    (1.10, 0.144, 0.144, 0.112, 0.092, 2.4),
    (1.25, 0.144, 0.144, 0.108, 0.092, 2.4),
    (1.42, 0.154, 0.154, 0.106, 0.102, 2.4),
    (1.60, 0.170, 0.170, 0.100, 0.120, 2.4),
    (1.75, 0.172, 0.172, 0.094, 0.130, 2.4),
    (1.88, 0.156, 0.156, 0.080, 0.112, 2.3),
    (2.00, 0.090, 0.090, 0.050, 0.060, 2.0),
)
# Bones: from the crown to the height of the chin, from there to the base of the neck.
HEAD: tuple[Row, ...] = (
    (0.00, 0.012, 0.012, 0.014, 0.014, 2.0),
    (0.03, 0.038, 0.038, 0.044, 0.046, 2.0),
    (0.10, 0.060, 0.060, 0.070, 0.076, 2.1),
    (0.22, 0.073, 0.073, 0.090, 0.095, 2.2),
    (0.36, 0.077, 0.077, 0.097, 0.101, 2.2),
    (0.48, 0.076, 0.076, 0.093, 0.100, 2.2),
    (0.62, 0.072, 0.072, 0.094, 0.090, 2.2),
    (0.76, 0.066, 0.066, 0.092, 0.074, 2.3),
    (0.90, 0.055, 0.055, 0.088, 0.060, 2.4),
    (0.98, 0.048, 0.048, 0.074, 0.056, 2.2),
    (1.08, 0.053, 0.053, 0.042, 0.058, 2.0),
    (1.40, 0.055, 0.055, 0.046, 0.060, 2.0),
    (2.00, 0.062, 0.062, 0.050, 0.066, 2.0),
)
# One bone along the sole, from the back of the heel to the tip of the shoe; ahead is upwards.
FOOT: tuple[Row, ...] = (
    (0.00, 0.020, 0.020, 0.045, 0.004, 2.4),
    (0.04, 0.031, 0.031, 0.075, 0.004, 2.5),
    (0.16, 0.036, 0.035, 0.092, 0.004, 2.6),
    (0.30, 0.037, 0.035, 0.098, 0.004, 2.4),
    (0.46, 0.041, 0.037, 0.082, 0.004, 2.4),
    (0.62, 0.049, 0.043, 0.063, 0.004, 2.6),
    (0.78, 0.051, 0.045, 0.049, 0.004, 2.7),
    (0.90, 0.043, 0.038, 0.041, 0.004, 2.7),
    (0.97, 0.028, 0.026, 0.032, 0.004, 2.5),
    (1.00, 0.012, 0.012, 0.016, 0.004, 2.2),
)
# One bone, along the thumb.
THUMB: tuple[Row, ...] = (
    (0.00, 0.010, 0.010, 0.014, 0.014, 2.0),
    (0.35, 0.012, 0.012, 0.014, 0.014, 2.0),
    (0.75, 0.010, 0.010, 0.011, 0.011, 2.0),
    (0.95, 0.007, 0.007, 0.008, 0.008, 2.0),
    (1.00, 0.003, 0.003, 0.003, 0.003, 2.0),
)


class Build(NamedTuple):
    """The differences of a person's measurements from the tables.

    Attributes:
        height_m: stature; all half widths are proportional to it.
        limbs: scale factor of the arms' and legs' half widths.
        chest: scale factor of the trunk's half widths, at the top.
        waist: the same in the middle.
        hips: the same at the bottom.
        belly_m: how far the belly stands out.
        bust_m: how far the bust stands out.
    """

    height_m: float = STATURE_M
    limbs: float = 1.0
    chest: float = 1.0
    waist: float = 1.0
    hips: float = 1.0
    belly_m: float = 0.0
    bust_m: float = 0.0

    @property
    def scale(self) -> float:
        """The stature, relative to that of the tables."""
        return self.height_m / STATURE_M


def sides(table: tuple[Row, ...], stations: Float[np.ndarray, " ring"]) -> tuple[Float[np.ndarray, "ring 4"], Float[np.ndarray, " ring"]]:
    """Half widths (outwards, inwards, ahead, behind) and roundness at some stations of a table."""
    rows = np.array(table)
    values = PchipInterpolator(rows[:, 0], rows[:, 1:])(stations)
    return values[:, :4], values[:, 4]


def trunk_factor(build: Build, stations: Float[np.ndarray, " ring"]) -> Float[np.ndarray, "ring 1"]:
    """Scale factors of the trunk's half widths: 1 at the neck, then chest, waist and hips."""
    return np.interp(stations, [0.1, 0.45, 0.8, 1.2, 1.7], [1.0, build.chest, build.chest, build.waist, build.hips])[:, None]


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
    centres, tangents = rings.centres[:, loose], rings.tangents[:, loose]
    felt = GRAVITY - _acceleration(centres, fps)
    felt = felt - np.sum(felt * tangents, axis=-1, keepdims=True) * tangents
    lag = _spring(felt, stiffness_hz, fps)
    lag_m = np.linalg.norm(lag, axis=-1, keepdims=True)
    room = room_m[loose][:, None]
    moved = rings.centres.copy()
    moved[:, loose] += room * np.tanh(lag_m / room) * unit(lag)
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
