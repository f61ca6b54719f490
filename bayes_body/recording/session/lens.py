r"""Intrinsics with which a camera sees nothing.

A lens that folds its picture at once, or an absurd focal length, leaves nothing to see. The radial coefficients fold the picture where their
polynomial stops growing (`base/geometry/camera.py`), the tangential ones at about $r = 1 / (6 |p|)$, with $r$ the distance from the optical axis at
unit depth.
"""

import math
from collections.abc import Iterator, Sequence

from bayes_body.base.geometry.camera import folding_radius

# Image side over focal length: from a twentieth of a degree to 168 degrees. A pinhole with distortion describes no wider lens.
NARROWEST, WIDEST = 1e-3, 20.0
# The image's nearest pixel, distance from the optical axis at unit depth: cut-outs of an image have their principal point outside, but not far.
FARTHEST = 10.0
# The lens must reach this share of the image's shorter side, from the principal point. A real lens folds near the image's edge, or outside.
LEAST_REACH = 0.25


def lens_faults(
    size_px: Sequence[int], focal_px: Sequence[float], centre_px: Sequence[float], distortion: Sequence[float]
) -> Iterator[tuple[str, str, str]]:
    """Why a camera sees nothing: for each fault the field, what was found, and what was expected.

    Args:
        size_px: (width, height) of its images.
        focal_px: focal lengths (x, y).
        centre_px: the principal point (column, row).
        distortion: (k1, k2, p1, p2, k3).
    """
    faults = list(_pinhole_faults(size_px, focal_px, centre_px))
    yield from faults
    # Without a sound focal length the lens's reach in pixels means nothing.
    if not faults:
        yield from _distortion_faults(min(size_px), min(focal_px), distortion)


def _pinhole_faults(size_px: Sequence[int], focal_px: Sequence[float], centre_px: Sequence[float]) -> Iterator[tuple[str, str, str]]:
    for axis, side, focal, centre in zip("xy", size_px, focal_px, centre_px, strict=True):
        if not side / WIDEST <= focal <= side / NARROWEST:
            expected = f"{side / WIDEST:g} to {side / NARROWEST:g} pixels for an image of {side}"
            yield "focal_px", f"{axis} = {focal:g}: the camera sees nothing", expected
        elif max(-centre, centre - side) > FARTHEST * focal:
            expected = f"{-FARTHEST * focal:g} to {side + FARTHEST * focal:g} pixels"
            yield "centre_px", f"{axis} = {centre:g}: the camera looks beside the scene", expected


def _distortion_faults(side: int, focal: float, distortion: Sequence[float]) -> Iterator[tuple[str, str, str]]:
    k1, k2, p1, p2, k3 = distortion
    least = LEAST_REACH * side
    if (reach := focal * _radial_reach(k1, k2, k3)) < least:
        problem = f"k1, k2, k3 = {k1:g}, {k2:g}, {k3:g}: the lens folds the picture {reach:.2g} pixels from the principal point"
        yield "distortion", problem, f"at least {least:g} pixels"
    if (largest := max(abs(p1), abs(p2))) * 6 * least > focal:
        problem = f"p1, p2 = {p1:g}, {p2:g}: the lens folds the picture {focal / (6 * largest):.2g} pixels from the principal point"
        yield "distortion", problem, f"at least {least:g} pixels"


def _radial_reach(k1: float, k2: float, k3: float) -> float:
    """The largest distance from the axis in the image, in focal lengths, before the picture folds; infinite if it never does."""
    r = folding_radius(k1, k2, k3)
    return r * abs(1 + r**2 * (k1 + r**2 * (k2 + r**2 * k3))) if math.isfinite(r) else math.inf
