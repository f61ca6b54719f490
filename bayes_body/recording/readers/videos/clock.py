"""The clock of a video: when each of its frames was filmed, by the timestamps in its file, and the rate that they show.

A header's rate is the number of frames over a duration: a gap, or the end of the last frame, changes it. The rate here is that of the steps between
frames. A step of ordinary length is one frame; a longer one is a gap. The slope of time against frame number is fitted with an intercept for each
stretch without a gap, since a camera that pauses goes on at any moment. A rate that the container states, or a usual one, replaces the fitted one if
the timestamps cannot tell them apart.
"""

from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bayes_body.base.errors import input_error
from bayes_body.recording.readers.videos.stream import Stamps, read_stamps
from bayes_body.recording.session.schema import MOST_FRAMES

# Limits of an ordinary step, in steps: a dropped frame makes a step of two.
ORDINARY = 0.25, 1.75
# The same where a slope is fitted: a camera that stumbles has another phase afterwards.
EVEN = 0.7, 1.3
# Streams without times repeat one; a few repeated times are damage.
MOST_REPEATED = 0.1
# The grid of instants lies in the middle between these percentiles of the frames' distances from it: single frames do not move it.
OUTER = 2.5, 97.5
# A frame this far from its instant, in steps, belongs to the next one: above a half, since frames midway would go to and fro.
FARTHEST = 0.6
CLOCKS_IN_MEMORY = 64


class VideoClock(NamedTuple):
    """When the frames of a video were filmed.

    Attributes:
        times_s: when, seconds, ascending. Frames that the header counts and the file lacks follow the last one at the nominal rate.
        fps: the nominal rate, frames per second; 0 if neither timestamps nor the header tell it.
        unit_s: the timestamps' resolution, seconds.
        instants: the number of each frame's instant: 0 for the first frame, one more for each frame that the camera filmed or should have filmed.
        errors: how far each frame is from its instant, in frames.
    """

    times_s: Float[np.ndarray, " frame"]
    fps: float
    unit_s: float
    instants: Int[np.ndarray, " frame"]
    errors: Float[np.ndarray, " frame"]

    @property
    def ordinary_s(self) -> Float[np.ndarray, " step"]:
        """The steps between successive frames that are no gaps, seconds."""
        steps = np.diff(self.times_s)
        return steps[_is_within(ORDINARY, steps, 1 / self.fps, self.unit_s)] if self.fps else steps[:0]


def video_clock(path: Path, state: tuple[int, int]) -> VideoClock:
    """The clock of a video. Its packets are read, no picture is decoded.

    Args:
        path: the file.
        state: the time of its last change and its size: the clocks of the last 64 files stay in memory.

    Raises:
        InputError: missing, not a video, or timestamps that span more than a million frames.
    """
    return _read(path, state)


@lru_cache(CLOCKS_IN_MEMORY)
def _read(path: Path, state: tuple[int, int]) -> VideoClock:
    del state
    clock = clock_of(read_stamps(path))
    if len(clock.instants) and clock.instants[-1] >= MOST_FRAMES:
        jump = int(np.argmax(np.diff(clock.times_s)))
        problem = f"its timestamps jump by {clock.times_s[jump + 1] - clock.times_s[jump]:.0f} s after frame {jump}"
        raise input_error(path, problem, f"at most {MOST_FRAMES} frames", "cut the video there, or convert it to a constant rate")
    return clock


def clock_of(stamps: Stamps) -> VideoClock:
    """The clock that timestamps show."""
    times, steps = stamps.times_s, np.diff(stamps.times_s)
    if len(steps) and np.mean(steps <= 0) > MOST_REPEATED:
        times, steps = times[:0], steps[:0]
    fps = _rate(times, stamps) if len(steps) else stamps.fps
    step = 1 / fps if fps else 0.0
    lacking = max(stamps.frames - len(times), 0)
    first = times[-1] + step if len(times) else 0.0
    times = np.concatenate([times, first + step * np.arange(lacking)])
    if not fps or not len(times):
        return VideoClock(times, 0.0, stamps.unit_s, np.arange(len(times)), np.zeros(len(times)))
    return VideoClock(times, fps, stamps.unit_s, *_instants(times, step))


def _is_within(limits: tuple[float, float], steps: Float[np.ndarray, " step"], step: float, unit_s: float) -> np.ndarray:
    """Which steps are within limits in units of a usual step, but for the timestamps' rounding."""
    shortest, longest = limits
    return (steps > shortest * step - unit_s) & (steps < longest * step + unit_s) & (steps > 0)


def _instants(times: Float[np.ndarray, " frame"], step: float) -> tuple[Int[np.ndarray, " frame"], Float[np.ndarray, " frame"]]:
    """The nearest points of a regular grid, counted from the first frame's, and the distances from them in steps."""
    position = (times - times[:1]) / step
    counted = np.concatenate([[0], np.cumsum(np.maximum(np.rint(np.diff(position)), 0))])
    lag = position - counted
    # The grid lies in the middle of the lags; of lags that grow beyond a step, in the middle of their fractions.
    if np.ptp(np.percentile(lag, OUTER)) < 1:
        lag -= np.mean(np.percentile(lag, OUTER))
    else:
        lag -= np.median(lag)
        lag -= np.mean(np.percentile(lag - np.rint(lag), OUTER))
    shifts, shift = np.zeros(len(lag)), 0
    if abs(lag).max() > FARTHEST:
        for frame, value in enumerate(lag.tolist()):
            shift = round(value) if abs(value - shift) > FARTHEST else shift
            shifts[frame] = shift
    instants = np.maximum.accumulate((counted + shifts).astype(int))
    return instants - instants[0], counted + lag - instants


def _rate(times: Float[np.ndarray, " frame"], stamps: Stamps) -> float:
    """Frames per second of timestamps of which most are in ascending order."""
    steps = np.diff(times)
    step = float(np.quantile(steps[steps > 0], 0.5, method="lower"))
    step = float(np.mean(steps[_is_within(ORDINARY, steps, step, stamps.unit_s)]))
    fitted, scatter, span = _fit(times, step, stamps.unit_s)
    # What the timestamps leave open over the recording, seconds: their rounding, and two standard errors of the slope.
    tolerance = stamps.unit_s + 2 * scatter * (12 / span) ** 0.5
    usual = sorted({float(round(1 / fitted)), round(1.001 / fitted) / 1.001}, key=lambda rate: abs(rate * fitted - 1))
    stated = [rate for rate in (stamps.fps, stamps.average_fps) if rate > 0]
    candidates = [*(rate for rate in stated if any(abs(rate / nice - 1) < 1e-6 for nice in usual if nice)), *usual, *stated]
    plausible = (rate for rate in candidates if rate > 0 and abs(1 / rate - fitted) * span <= tolerance)
    return next(plausible, 1 / fitted)


def _fit(times: Float[np.ndarray, " frame"], step: float, unit_s: float) -> tuple[float, float, int]:
    """The slope of time against frame number, one intercept for each stretch of even steps; the scatter; the frames of the longest stretch."""
    steps = np.diff(times)
    stretch = np.concatenate([[0], np.cumsum(~_is_within(EVEN, steps, step, unit_s))])
    number = np.arange(len(times), dtype=float)
    counts = np.bincount(stretch)

    def centred(values: Float[np.ndarray, " frame"]) -> Float[np.ndarray, " frame"]:
        return values - (np.bincount(stretch, values) / counts)[stretch]

    numbers, seconds = centred(number), centred(times)
    variance = float(numbers @ numbers)
    slope = float(numbers @ seconds) / variance if variance else step
    return slope, float(np.sqrt(np.mean((seconds - slope * numbers) ** 2))), int(counts.max())
