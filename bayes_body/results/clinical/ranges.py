"""Peaks and ranges of motion of joint angles: the largest and the smallest value along each draw, and their difference.

Each draw of a smoothed run is a path, and has a peak. Mean and quantiles are those of the peaks over the draws. The peak of the mean curve is another
quantity: it is smaller, since the draws have their peaks at different times. The draws of a filter belong to single frames and have no peaks.
"""

from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.results.clinical.conventions import Side
from bayes_body.results.clinical.gait import FEET, Gait, Stride
from bayes_body.results.clinical.trajectories import AnglePaths


class AngleRange(NamedTuple):
    """The range of an angle, degrees; NaN in draws that do not have it.

    Attributes:
        name: the angle, without its side.
        side: its side.
        stride: the number of the stride of `stride_side`, from 1; 0 for the whole recording.
        stride_side: the foot whose stride it is; empty for the whole recording.
        largest: the largest value.
        smallest: the smallest value.
    """

    name: str
    side: Side
    stride: int
    stride_side: Side
    largest: Float[np.ndarray, " draw"]
    smallest: Float[np.ndarray, " draw"]

    @property
    def label(self) -> str:
        """The angle with its side, such as `knee_flexion_r`."""
        return f"{self.name}_{self.side}" if self.side else self.name

    @property
    def extent(self) -> Float[np.ndarray, " draw"]:
        """The range of motion."""
        return self.largest - self.smallest


def ranges_of(paths: AnglePaths) -> list[AngleRange]:
    """Return the ranges over the whole recording."""
    largest, smallest = (np.stack([of(path, axis=0) for path in paths.degrees]) for of in (np.max, np.min))
    return [AngleRange(name, side, 0, "", largest[:, k], smallest[:, k]) for k, (name, side) in enumerate(zip(paths.names, paths.sides, strict=True))]


def stride_ranges(paths: AnglePaths, gait: Gait, fps: float) -> list[AngleRange]:
    """Return the ranges in each stride: of the angles of its side and of those in the middle of the body."""
    columns = {foot: [k for k, side in enumerate(paths.sides) if side in (foot, "")] for foot in FEET}
    ends = [np.full((2, len(paths.draws), len(columns[stride.side])), np.nan) for stride in gait.strides]
    for draw, path in enumerate(paths.degrees if gait.strides else ()):
        for stride, (largest, smallest) in zip(gait.strides, ends, strict=True):
            values = _within(path, stride, int(paths.draws[draw]), fps)[:, columns[stride.side]]
            if values.size:
                largest[draw], smallest[draw] = values.max(axis=0), values.min(axis=0)
    ranges, count = [], {"r": 0, "l": 0}
    for stride, (largest, smallest) in zip(gait.strides, ends, strict=True):
        count[stride.side] += 1
        ranges += [
            AngleRange(paths.names[k], paths.sides[k], count[stride.side], stride.side, largest[:, place], smallest[:, place])
            for place, k in enumerate(columns[stride.side])
        ]
    return ranges


def _within(path: Float[np.ndarray, "frame angle"], stride: Stride, draw: int, fps: float) -> Float[np.ndarray, "inside angle"]:
    """Return the values of a path between the two strikes of a stride; none if the draw lacks one of them."""
    begin, duration = fps * stride.start[draw], fps * stride.duration[draw]
    if not np.isfinite(begin + duration):
        return path[:0]
    return path[max(int(np.ceil(begin)), 0) : int(begin + duration) + 1]


def range_figures(ranges: list[AngleRange], undetermined: Collection[str] = ()) -> dict[str, Any]:
    """Return the ranges over a recording for `summary.json`: for each angle the moments of `max_deg`, `min_deg` and `range_deg`.

    Args:
        ranges: the ranges.
        undetermined: names of angles, with their sides, that the images do not determine; their `determined` is false.
    """
    return {
        angle_range.label: {
            **{
                name: _moments(values)
                for name, values in (("max_deg", angle_range.largest), ("min_deg", angle_range.smallest), ("range_deg", angle_range.extent))
            },
            "determined": angle_range.label not in undetermined,
        }
        for angle_range in ranges
    }


def _moments(values: Float[np.ndarray, " draw"]) -> dict[str, float]:
    low, high = np.quantile(values, (0.05, 0.95))
    return {"mean": float(values.mean()), "sd": float(values.std()), "q05": float(low), "q95": float(high)}
