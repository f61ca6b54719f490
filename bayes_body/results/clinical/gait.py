r"""Gait events and strides of every draw of a walk: foot strike, toe off, stride length and time, stance, cadence, speed.

Of each draw, a whole trajectory, the ankle's distance ahead of the pelvis is followed along the direction that the pelvis faces. A foot strikes near
its largest value and leaves the floor near its smallest (Zeni, Richards & Higginson 2008, Two simple methods for determining gait events); a parabola
through three frames gives the time between frames. These instants differ from those of the foot's contact by an error of the method, which was
measured on captured walks (`CONTACT`, `LIFT`). It is taken out on average, and its spread is a part of the uncertainty: each draw gets its own error,
$t = t_{extremum} - b - s_{walk} u - s_{event} v$, with u for all events of one kind and v for each. v is normal. u has Student's t distribution with
four degrees of freedom, because the error was measured on five people.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import uniform_filter1d
from scipy.signal import butter, find_peaks, sosfiltfilt

from bayes_body.base.errors import input_error

type Kind = Literal["foot strike", "toe off"]
type FootSide = Literal["r", "l"]
FEET: tuple[FootSide, ...] = ("r", "l")
# Markers that are required, in this order.
POINTS = ("l_hip", "r_hip", "l_ankle", "r_ankle")
# Motion of walking people is slower than this, Hz: what is faster in a draw is noise (Winter 2009, 2.2.4). At low frame rates a share of the rate.
CUTOFF_HZ, LARGEST_SHARE = 6.0, 0.2
# Strides take at least this long, s. The ankle swings past the pelvis by more than this share of the leg's length.
SHORTEST_S, PROMINENCE = 0.6, 0.15
# The facing of the pelvis is averaged over a stride, s.
FACING_S = 1.0
# An event of a draw belongs to one of the mean path if it is nearer than this, s.
NEAR_S = 0.25
FEWEST_FRAMES = 4
SEED = 20081


class MethodError(NamedTuple):
    """How much later an extremum is than the foot's contact, s: mean, standard deviation between walks, and between the events of a walk."""

    mean: float
    walks: float
    events: float


# Against the speed of heel and toes (Ghoussayni et al. 2004, limit 0.5 m/s) in captured walks of five people: 02, 05, 07, 08 and 16 of the CMU set.
# Other people's walks check it (tests/results/clinical/test_gait.py).
CONTACT = MethodError(-0.023, 0.0055, 0.0045)
LIFT = MethodError(0.015, 0.009, 0.0065)
FREEDOM = 4


class Event(NamedTuple):
    """An event of a walk.

    Attributes:
        kind: `foot strike` or `toe off`.
        side: the foot.
        times: time in each draw, s from the first frame; NaN in draws that do not have the event.
    """

    kind: Kind
    side: FootSide
    times: Float[np.ndarray, " draw"]

    @property
    def share(self) -> float:
        """The share of the draws that have the event."""
        return float(np.isfinite(self.times).mean())


class Stride(NamedTuple):
    """A stride: from a strike of a foot to the next of the same foot. NaN in draws that lack one of its events.

    Attributes:
        side: the foot.
        start: time of the first strike, s.
        duration: s.
        length: horizontal distance between the ankle at both strikes, metres.
        stance: share of the stride in which the foot is on the floor; NaN if its toe off was not seen.
    """

    side: FootSide
    start: Float[np.ndarray, " draw"]
    duration: Float[np.ndarray, " draw"]
    length: Float[np.ndarray, " draw"]
    stance: Float[np.ndarray, " draw"]


class Gait(NamedTuple):
    """The events in the order of time, and the strides."""

    events: tuple[Event, ...]
    strides: tuple[Stride, ...]


def gait_of(paths: Float[np.ndarray, "draw frame 4 3"], fps: float, up: int) -> Gait:
    """Return the gait of the draws of a walk.

    Args:
        paths: positions of the markers POINTS, metres; each draw is a whole trajectory.
        fps: frames a second.
        up: index of the axis that points up.

    Raises:
        InputError: there are too few frames to filter.
    """
    least = int(np.ceil(fps * SHORTEST_S))
    if paths.shape[1] < max(least, FEWEST_FRAMES):
        raise input_error("gait", f"{paths.shape[1]} frames", f"at least {max(least, FEWEST_FRAMES)}: a short stride", "track a longer recording")
    # The mean path is one more draw: its events are those that the draws' are assigned to.
    smooth = low_pass(np.concatenate([paths, paths.mean(axis=0, keepdims=True)]), fps)
    rng = np.random.default_rng(SEED)
    # What the method misses in a whole walk is the same for both feet.
    walks = [error.mean + error.walks * rng.standard_t(FREEDOM, size=len(paths)) for error in (CONTACT, LIFT)]
    events, strides = [], []
    for side in FEET:
        hip, ankle = (smooth[:, :, POINTS.index(f"{side}_{joint}")] for joint in ("hip", "ankle"))
        ankle_lead = _measure_ankle_lead(smooth, ankle, fps, up)
        least_swing = PROMINENCE * float(np.percentile(np.linalg.norm(hip[-1] - ankle[-1], axis=-1), 95))
        strikes, lifts = (
            [time - walk - error.events * rng.normal(size=len(paths)) for time in _times(sign * ankle_lead, fps, least_swing)]
            for sign, walk, error in zip((1, -1), walks, (CONTACT, LIFT), strict=True)
        )
        events += [Event("foot strike", side, times) for times in strikes] + [Event("toe off", side, times) for times in lifts]
        strides += _strides(side, strikes, lifts, np.delete(ankle[:-1], up, axis=-1), fps)
    return Gait(tuple(sorted(events, key=_when)), tuple(sorted(strides, key=lambda stride: float(np.nanmean(stride.start)))))


def cadence(gait: Gait) -> Float[np.ndarray, " draw"]:
    """Return the steps a minute of each draw: two in the mean duration of a stride."""
    return 120 / known_mean([stride.duration for stride in gait.strides])


def speed(gait: Gait) -> Float[np.ndarray, " draw"]:
    """Return the speed of each draw, m/s: the lengths of its strides over their durations."""
    return known_mean([stride.length for stride in gait.strides]) / known_mean([stride.duration for stride in gait.strides])


def known_mean(values: Sequence[Float[np.ndarray, " draw"]]) -> Float[np.ndarray, " draw"]:
    """Return the mean over several quantities in each draw, of those that the draw has; NaN if it has none."""
    is_finite = np.isfinite(values)
    with np.errstate(invalid="ignore"):
        return np.where(is_finite, values, 0.0).sum(axis=0) / is_finite.sum(axis=0)


def _when(event: Event) -> float:
    return float(np.nanmean(event.times))


def low_pass(paths: Float[np.ndarray, "draw frame *of"], fps: float) -> Float[np.ndarray, "draw frame *of"]:
    """Return the paths without what is faster than walking (CUTOFF_HZ), by a Butterworth filter forwards and backwards."""
    sections = butter(2, min(CUTOFF_HZ / fps, LARGEST_SHARE) * 2, output="sos")
    return sosfiltfilt(sections, paths, axis=1, padlen=min(int(fps), paths.shape[1] - 1))


def _measure_ankle_lead(
    smooth: Float[np.ndarray, "draw frame 4 3"], ankle: Float[np.ndarray, "draw frame 3"], fps: float, up: int
) -> Float[np.ndarray, "draw frame"]:
    """Return how far the ankle is ahead of the pelvis, metres, along the direction that the pelvis faces on average over a stride."""
    hip_axis = uniform_filter1d(smooth[:, :, 0] - smooth[:, :, 1], max(int(FACING_S * fps), 1), axis=1, mode="nearest")
    forward = np.cross(hip_axis, np.eye(3)[up])
    forward /= np.maximum(np.linalg.norm(forward, axis=-1, keepdims=True), 1e-9)
    return np.einsum("sfa,sfa->sf", ankle - smooth[:, :, :2].mean(axis=2), forward)


def _times(values: Float[np.ndarray, "row frame"], fps: float, least: float) -> list[Float[np.ndarray, " draw"]]:
    """Return the times of the maxima of the last row, the mean path, in each other row, a draw, s; NaN where a draw has none nearby."""
    maxima = [_maxima(row, fps, least) for row in values]
    draws, mean = maxima[:-1], maxima[-1]
    if not len(mean):
        return []
    times = np.full((len(mean), len(draws)), np.nan)
    for d, draw_maxima in enumerate(draws):
        if len(draw_maxima):
            nearest = draw_maxima[np.abs(draw_maxima - mean[:, None]).argmin(axis=1)]
            times[:, d] = np.where(np.abs(nearest - mean) < NEAR_S, nearest, np.nan)
    return [event for event in times if np.isfinite(event).any()]


def _maxima(row: Float[np.ndarray, " frame"], fps: float, least: float) -> Float[np.ndarray, " event"]:
    """Return the times of the maxima, s, between frames by a parabola."""
    peaks = find_peaks(row, distance=max(int(SHORTEST_S * fps), 1), prominence=least)[0]
    left_height, height, right_height = row[peaks - 1], row[peaks], row[peaks + 1]
    bend = left_height - 2 * height + right_height
    return (peaks + np.where(bend < 0, (left_height - right_height) / np.where(bend < 0, 2 * bend, 1), 0.0)) / fps


def _strides(
    side: FootSide,
    strikes: list[Float[np.ndarray, " draw"]],
    lifts: list[Float[np.ndarray, " draw"]],
    floor: Float[np.ndarray, "draw frame 2"],
    fps: float,
) -> list[Stride]:
    """Return the strides of a foot from its strikes, in order; `floor` is the ankle's horizontal position."""
    strides = []
    for first, last in pairwise(strikes):
        length = np.linalg.norm(_interpolate(floor, last * fps) - _interpolate(floor, first * fps), axis=-1)
        inside = [lift for lift in lifts if np.nanmean(first) < np.nanmean(lift) < np.nanmean(last)]
        stance = (inside[0] - first) / (last - first) if inside else np.full(len(first), np.nan)
        if np.isfinite(length).any():
            strides.append(Stride(side, first, last - first, length, stance))
    return strides


def _interpolate(floor: Float[np.ndarray, "draw frame 2"], frames: Float[np.ndarray, " draw"]) -> Float[np.ndarray, "draw 2"]:
    """Return the positions at times between frames; NaN where the time is."""
    is_finite: Bool[np.ndarray, " draw"] = np.isfinite(frames)
    lower = np.clip(np.floor(np.where(is_finite, frames, 0)).astype(int), 0, floor.shape[1] - 2)
    share = (np.where(is_finite, frames, np.nan) - lower)[:, None]
    draws = np.arange(len(floor))
    return (1 - share) * floor[draws, lower] + share * floor[draws, lower + 1]
