"""A person's measurements: half widths of the body's sections at selected stations, for a man of 1.75 m, in metres.

Circumferences follow the US Army's survey of 1988 (Gordon et al. 1989, ANSUR), medians of men: thigh 0.59, calf 0.38, ankle 0.22, chest 0.99,
waist 0.86, hips 0.98, upper arm 0.33, forearm 0.30, wrist 0.17, head 0.57, neck 0.38. A monotone cubic interpolates between the stations.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator

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
