"""The unit of keypoints: pixels, or shares of the image's width and height (0 to 1), as networks write that work on scaled images."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from bayes_body.base.errors import InputError, input_error, nearest
from bayes_body.recording.readers.keypoints.person import People

UNITS = ("px", "share")
# A share of an image's side is between 0 and 1; a person in pixels is larger than this.
LARGEST_SHARE = 2.0
# Of fewer coordinates nothing is said.
FEWEST_COORDINATES = 10


def check_unit(unit: str | None) -> None:
    """Refuse an unknown unit of keypoints.

    Raises:
        InputError: it is not one of UNITS.
    """
    if unit is not None and unit not in UNITS:
        raise InputError(f"--keypoints-unit: '{unit}': no such unit; {nearest(unit, UNITS)}")


def are_shares(groups: Iterable[People]) -> bool:
    """Whether all coordinates of some people are so small that they are no pixels."""
    places = [group[..., :2][np.isfinite(group[..., :2])] for group in groups]
    coordinates = np.concatenate(places) if places else np.zeros(0)
    return coordinates.size >= FEWEST_COORDINATES and bool((np.abs(coordinates) <= LARGEST_SHARE).all())


def in_pixels(
    cameras: Mapping[str, Sequence[People]], sizes_px: Mapping[str, tuple[int, int]], unit: str | None = None
) -> dict[str, Sequence[People]]:
    """The people of each camera in pixels.

    Args:
        cameras: of each camera, the people of its frames.
        sizes_px: of each camera, the width and the height of its images.
        unit: of the keypoints, `px` or `share`; pixels by default.

    Raises:
        InputError: they are in the other unit.
    """
    shares = [name for name, groups in cameras.items() if are_shares(groups)]
    if unit != "share":
        if shares:
            listed = ", ".join(shares)
            problem = f"{listed}: no coordinate is above {LARGEST_SHARE:g}"
            remedy = "if they are shares of the image's width and height, from 0 to 1, give --keypoints-unit share"
            raise input_error("keypoints", problem, "pixels", remedy)
        return dict(cameras)
    if pixels := [name for name, groups in cameras.items() if any(map(len, groups)) and name not in shares]:
        problem = f"{', '.join(pixels)}: coordinates above {LARGEST_SHARE:g}"
        raise input_error("--keypoints-unit share", problem, "shares of the image's width and height, from 0 to 1", "leave the option out")
    return {name: [_scaled(group, sizes_px[name]) for group in groups] for name, groups in cameras.items()}


def _scaled(people: People, size_px: tuple[int, int]) -> People:
    return people * np.array([*size_px, 1.0])
