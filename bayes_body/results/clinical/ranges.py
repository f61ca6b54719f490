"""Peaks and ranges of motion of joint angles: the largest and the smallest value along each draw, and their difference.

Each draw of a smoothed run is a path, and has a peak. Mean and quantiles are those of the peaks over the draws. The peak of the mean curve is another
quantity: it is smaller, since the draws have their peaks at different times. The draws of a filter belong to single frames and have no peaks.
"""

from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.results.clinical.conventions import Side
from bayes_body.results.clinical.gait import Gait, Stride
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
    largest, smallest = paths.degrees.max(axis=1), paths.degrees.min(axis=1)
    return [AngleRange(name, side, 0, "", largest[:, k], smallest[:, k]) for k, (name, side) in enumerate(zip(paths.names, paths.sides, strict=True))]


def stride_ranges(paths: AnglePaths, gait: Gait, fps: float) -> list[AngleRange]:
    """Return the ranges in each stride: of the angles of its side and of those in the middle of the body."""
    ranges, count = [], {"r": 0, "l": 0}
    for stride in gait.strides:
        count[stride.side] += 1
        columns = [k for k, side in enumerate(paths.sides) if side in (stride.side, "")]
        largest, smallest = _within(paths, columns, stride, fps)
        ranges += [
            AngleRange(paths.names[k], paths.sides[k], count[stride.side], stride.side, largest[:, place], smallest[:, place])
            for place, k in enumerate(columns)
        ]
    return ranges


def _within(
    paths: AnglePaths, columns: list[int], stride: Stride, fps: float
) -> tuple[Float[np.ndarray, "draw column"], Float[np.ndarray, "draw column"]]:
    """Return the largest and the smallest values of each draw between the two strikes of its stride."""
    begin, duration = fps * stride.start[paths.draws], fps * stride.duration[paths.draws]
    is_finite = np.isfinite(begin + duration)
    largest, smallest = np.full((2, len(begin), len(columns)), np.nan)
    for draw in np.flatnonzero(is_finite):
        first = max(int(np.ceil(begin[draw])), 0)
        values = paths.degrees[draw, first : int(begin[draw] + duration[draw]) + 1, columns]
        if values.size:
            largest[draw], smallest[draw] = values.max(axis=-1), values.min(axis=-1)
    return largest, smallest


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
