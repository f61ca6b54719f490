r"""Where a lens folds its picture.

With $r$ the distance from the optical axis at unit depth, the lens maps $r$ to $r (1 + k_1 r^2 + k_2 r^4 + k_3 r^6)$. Where this stops growing, the
picture folds back: points further out would land on those further in.
"""

import math

import numpy as np

# No lens has coefficients like this; their powers would overflow.
LARGEST_COEFFICIENT = 1e9


def folding_radius(k1: float, k2: float, k3: float) -> float:
    """Return the smallest $r$ at which the distortion stops growing; infinite if it never does, 0 for coefficients of no lens."""
    # The derivative's roots in 1 / r^2: a leading coefficient of 1 needs no division, which could overflow.
    derivative = np.array([1.0, 3 * k1, 5 * k2, 7 * k3])
    if not (np.abs(derivative) <= LARGEST_COEFFICIENT).all():
        return 0.0
    roots = np.roots(derivative)
    real = roots[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0)].real
    return float(1 / np.sqrt(real.max())) if real.size else math.inf
