r"""Gait events and strides of every draw of a walk: foot strike, toe off, stride length and time, stance, cadence, speed.

Of each draw, a whole trajectory, the ankle's distance ahead of the pelvis is followed along the direction that the pelvis faces. A foot strikes near
its largest value and leaves the floor near its smallest (Zeni, Richards & Higginson 2008, Two simple methods for determining gait events); a parabola
through three frames gives the time between frames. These instants differ from those of the foot's contact by an error of the method, which was
measured on captured walks (`CONTACT`, `LIFT`). It is taken out on average, and its spread is a part of the uncertainty: each draw gets its own error,
$t = t_{extremum} - b - s_{walk} u - s_{event} v$, with u for all events of one kind and v for each. v is normal. u has Student's t distribution with
four degrees of freedom, because the error was measured on five people.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import uniform_filter1d
from scipy.signal import butter, find_peaks, sosfiltfilt

from bayes_body.base.errors import input_error
from bayes_body.results.clinical.paths import PathsOfDraws, mean_path

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


def gait_of(paths: PathsOfDraws, fps: float, up: int) -> Gait:
    """Return the gait of the draws of a walk. One draw is in memory at a time.

    Args:
        paths: positions (draw, frame, 4, 3) of the markers POINTS, metres; each draw is a whole trajectory.
        fps: frames a second.
        up: index of the axis that points up.

    Raises:
        InputError: there are too few frames to filter.
    """
    least = int(np.ceil(fps * SHORTEST_S))
    if paths.shape[1] < max(least, FEWEST_FRAMES):
        raise input_error("gait", f"{paths.shape[1]} frames", f"at least {max(least, FEWEST_FRAMES)}: a short stride", "track a longer recording")
    # The mean path's events are those that the draws' are assigned to.
    mean = low_pass(mean_path(paths)[None], fps)[0]
    least_swing = {side: PROMINENCE * float(np.percentile(_leg_lengths(mean, side), 95)) for side in FEET}
    mean_extrema = _extrema(mean, fps, up, least_swing)
    extrema = [_extrema(low_pass(path[None], fps)[0], fps, up, least_swing) for path in paths]
    rng = np.random.default_rng(SEED)
    # What the method misses in a whole walk is the same for both feet.
    walks = [error.mean + error.walks * rng.standard_t(FREEDOM, size=len(paths)) for error in (CONTACT, LIFT)]
    events, strikes_of, lifts_of = [], {}, {}
    for side in FEET:
        strikes_of[side], lifts_of[side] = (
            [
                time - walk - error.events * rng.normal(size=len(paths))
                for time in _times([times[side][kind] for times in extrema], mean_extrema[side][kind])
            ]
            for kind, walk, error in zip((0, 1), walks, (CONTACT, LIFT), strict=True)
        )
        events += [Event("foot strike", side, times) for times in strikes_of[side]] + [Event("toe off", side, times) for times in lifts_of[side]]
    places = _strike_places(paths, strikes_of, fps, up)
    strides = [stride for side in FEET for stride in _strides(side, strikes_of[side], lifts_of[side], places[side])]
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


def _ankle(path: Float[np.ndarray, "frame 4 3"], side: str) -> Float[np.ndarray, "frame 3"]:
    return path[:, POINTS.index(f"{side}_ankle")]


def _leg_lengths(path: Float[np.ndarray, "frame 4 3"], side: str) -> Float[np.ndarray, " frame"]:
    return np.linalg.norm(path[:, POINTS.index(f"{side}_hip")] - _ankle(path, side), axis=-1)


def _extrema(
    smooth: Float[np.ndarray, "frame 4 3"], fps: float, up: int, least_swing: Mapping[str, float]
) -> dict[str, tuple[Float[np.ndarray, " maximum"], Float[np.ndarray, " minimum"]]]:
    """Return the times, s, at which the ankle of each side is farthest ahead of the pelvis of a path, and farthest behind."""
    leads = {side: _measure_ankle_lead(smooth, _ankle(smooth, side), fps, up) for side in FEET}
    return {side: (_maxima(lead, fps, least_swing[side]), _maxima(-lead, fps, least_swing[side])) for side, lead in leads.items()}


def _measure_ankle_lead(
    smooth: Float[np.ndarray, "frame 4 3"], ankle: Float[np.ndarray, "frame 3"], fps: float, up: int
) -> Float[np.ndarray, " frame"]:
    """Return how far the ankle is ahead of the pelvis, metres, along the direction that the pelvis faces on average over a stride."""
    hip_axis = uniform_filter1d(smooth[:, 0] - smooth[:, 1], max(int(FACING_S * fps), 1), axis=0, mode="nearest")
    forward = np.cross(hip_axis, np.eye(3)[up])
    forward /= np.maximum(np.linalg.norm(forward, axis=-1, keepdims=True), 1e-9)
    return np.einsum("fa,fa->f", ankle - smooth[:, :2].mean(axis=1), forward)


def _times(draws: Sequence[Float[np.ndarray, " _"]], mean: Float[np.ndarray, " event"]) -> list[Float[np.ndarray, " draw"]]:
    """Return the times of the events of the mean path in each draw, s; NaN where a draw has none nearby."""
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


def _strike_places(
    paths: PathsOfDraws, strikes: Mapping[str, Sequence[Float[np.ndarray, " draw"]]], fps: float, up: int
) -> dict[str, Float[np.ndarray, "strike draw 2"]]:
    """Return where the ankle is at each strike, metres, in the horizontal plane."""
    frames = {side: fps * np.array(times).reshape(-1, len(paths)) for side, times in strikes.items()}
    places = {side: np.zeros((*times.shape, 2)) for side, times in frames.items()}
    for draw, path in enumerate(paths):
        smooth = low_pass(path[None], fps)[0]
        for side, times in frames.items():
            places[side][:, draw] = _interpolate(np.delete(_ankle(smooth, side), up, axis=-1), times[:, draw])
    return places


def _strides(
    side: FootSide,
    strikes: Sequence[Float[np.ndarray, " draw"]],
    lifts: Sequence[Float[np.ndarray, " draw"]],
    places: Float[np.ndarray, "strike draw 2"],
) -> list[Stride]:
    """Return the strides of a foot from its strikes, in order; `places` are where the ankle is at them."""
    strides = []
    for (first, start), (last, end) in pairwise(zip(strikes, places, strict=True)):
        length = np.linalg.norm(end - start, axis=-1)
        inside = [lift for lift in lifts if np.nanmean(first) < np.nanmean(lift) < np.nanmean(last)]
        stance = (inside[0] - first) / (last - first) if inside else np.full(len(first), np.nan)
        if np.isfinite(length).any():
            strides.append(Stride(side, first, last - first, length, stance))
    return strides


def _interpolate(floor: Float[np.ndarray, "frame 2"], frames: Float[np.ndarray, " strike"]) -> Float[np.ndarray, "strike 2"]:
    """Return the positions at times between frames; NaN where the time is."""
    is_finite: Bool[np.ndarray, " strike"] = np.isfinite(frames)
    lower = np.clip(np.floor(np.where(is_finite, frames, 0)).astype(int), 0, len(floor) - 2)
    share = (np.where(is_finite, frames, np.nan) - lower)[:, None]
    return (1 - share) * floor[lower] + share * floor[lower + 1]
