"""Pair the frames of the cameras' videos by time.

The timestamps of each video are the truth about its steps (clock.py). They say nothing about the time between cameras: every file counts from
its own first frame, and only `--offset` moves a camera. A camera that lost frames has none at their instants. Cameras of one rate are paired by
instant, unless their rates differ so little that it shows only after a while: then, and for different rates on request, each instant of the slowest
camera is paired with the nearest frame of the others.
"""

from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bayes_body.base.errors import input_error
from bayes_body.recording.readers.videos.clock import VideoClock
from bayes_body.recording.session.session import Span

# Two videos with the same rate; their containers round it differently.
SAME_RATE = 5e-4
# Relative difference up to which two rates are mistaken for each other, as 59.94 and 60 are.
NEAR_RATE = 0.01
# Errors of a frame's time, in frames, that a user should know: of steps that are systematically uneven, and of any frame.
UNEVEN, FAR = 0.15, 0.25
# Rates that no camera films people with, or that a slow-motion video or an old container states falsely.
SLOWEST, FASTEST = 5.0, 1000.0
MOST_PLACES = 5


class Paired(NamedTuple):
    """The rate and the frames of cameras that were paired by time.

    Attributes:
        fps: frames per second.
        counts: the number of instants of each camera with a video.
        spans: where its frames are, of cameras whose frames are not one at each instant.
        remarks: for the user, one sentence each.
    """

    fps: float
    counts: dict[str, int]
    spans: dict[str, tuple[Span, ...]]
    remarks: list[str]


def pair_frames(clocks: Mapping[str, VideoClock], user_rate: float | None, resample: bool, offsets: Mapping[str, int]) -> Paired:
    """Pair the frames of videos.

    Args:
        clocks: each video camera's.
        user_rate: frames per second that the user states for all videos; it scales their clocks, and gaps stay gaps.
        resample: whether cameras of different rates are paired by time, at the slowest rate.
        offsets: the user's, in frames, for some cameras.

    Raises:
        InputError: no rate is known, or the cameras differ and are not to be resampled.
    """
    rates = {name: clock.fps for name, clock in clocks.items()}
    slowest = min((rate for rate in rates.values() if rate > 0), default=0.0)
    resampled = _resampled(clocks, slowest, resample)
    if resampled:
        fps, remarks = user_rate or round(slowest, 6), [] if user_rate is None else _overriding(rates, user_rate)
    else:
        fps, remarks = frame_rate(rates, user_rate)
    remarks += [*_describe_clocks(clocks), *_describe_late_starts(clocks, offsets)]
    remarks += [] if user_rate is not None else _describe_improbable(rates)
    remarks += [] if user_rate is None or resampled else _describe_drift(clocks)
    frames = {name: _frames(clock, slowest if resampled else clock.fps) for name, clock in clocks.items()}
    if resampled:
        remarks.append(_describe_resampling(clocks, frames, slowest, resample))
    spans = {name: _spans(*pairs) for name, pairs in frames.items()}
    counts = {name: runs[-1].instant + runs[-1].frames for name, runs in spans.items()}
    spans = {name: runs for name, runs in spans.items() if runs != (Span(0, 0, len(clocks[name].times_s)),)}
    return Paired(fps, counts, spans, remarks)


def frame_rate(rates: Mapping[str, float], user_rate: float | None) -> tuple[float, list[str]]:
    """The session's frame rate (frames per second), and remarks.

    Args:
        rates: each camera's rate, 0 if its recording does not state it.
        user_rate: the user's rate; overrides the videos' rates.

    Raises:
        InputError: no rate is known, or the cameras differ.
    """
    stated_rates = {name: rate for name, rate in rates.items() if rate > 0}
    if user_rate is not None:
        return user_rate, _overriding(stated_rates, user_rate)
    if not stated_rates:
        raise input_error(
            "--fps",
            "not given, and no recording states its frame rate",
            "frames per second",
            "give the rate at which the cameras filmed, such as --fps 60",
        )
    if _differ(stated_rates.values()):
        listed = ", ".join(f"{name} {rate:g}" for name, rate in stated_rates.items())
        remedy = "give --resample to pair their frames by time at the slowest rate, or --fps if all filmed at one rate that their files misstate"
        raise input_error("frame rate", f"cameras differ: {listed}", "one rate", remedy)
    # Containers round the rate, so the mean is nearer to the truth than any single camera's.
    return round(sum(stated_rates.values()) / len(stated_rates), 6), []


def _differ(rates: Iterable[float]) -> bool:
    slowest, *_, fastest = sorted([*rates] * 2)
    return fastest - slowest > SAME_RATE * fastest


def _overriding(rates: Mapping[str, float], user_rate: float) -> list[str]:
    overridden = [f"{name} {rate:g}" for name, rate in rates.items() if rate > 0 and abs(rate - user_rate) > SAME_RATE * user_rate]
    return [f"--fps {user_rate:g} overrides the videos' rates ({', '.join(overridden)})."] if overridden else []


def _resampled(clocks: Mapping[str, VideoClock], slowest: float, resample: bool) -> bool:
    """Whether frames are paired on the slowest camera's clock: on request, or where nearly equal rates drift apart in the recording."""
    rates = [clock.fps for clock in clocks.values()]
    if not slowest or min(rates) <= 0:
        return False
    if _differ(rates):
        return resample
    drift = max((clock.fps / slowest - 1) * clock.instants[-1] for clock in clocks.values())
    return bool(drift > FAR)


def _frames(clock: VideoClock, fps: float) -> tuple[Int[np.ndarray, " pair"], Int[np.ndarray, " pair"]]:
    """Instants at a rate, and for each the camera's nearest frame; instants without a frame nearby are left out."""
    if not clock.fps or fps == clock.fps:
        instants, errors, farthest = clock.instants, abs(clock.errors), np.inf
    else:
        times = _positions(clock) * (fps / clock.fps)
        instants = np.rint(times).astype(int)
        errors, farthest = abs(times - instants), min(0.5, 0.75 * fps / clock.fps)
    # The nearest frame of each instant comes first.
    frames = np.lexsort((errors, instants))
    instants, errors = instants[frames], errors[frames]
    chosen = np.concatenate([[True], np.diff(instants) > 0]) & (errors <= farthest) & (instants >= 0)
    return instants[chosen], frames[chosen]


def _positions(clock: VideoClock) -> Float[np.ndarray, " frame"]:
    """The times of a camera's frames in its own frames, from the instant of the first."""
    return clock.instants + clock.errors


def _spans(instants: Int[np.ndarray, " pair"], frames: Int[np.ndarray, " pair"]) -> tuple[Span, ...]:
    starts = np.flatnonzero(np.concatenate([[True], (np.diff(instants) != 1) | (np.diff(frames) != 1)]))
    counts = np.diff(starts, append=len(instants))
    return tuple(Span(*row) for row in zip(instants[starts].tolist(), frames[starts].tolist(), counts.tolist(), strict=True))


def _describe_clocks(clocks: Mapping[str, VideoClock]) -> Iterator[str]:
    """Sentences on gaps, on frames that come too early, and on rates that vary."""
    for name, clock in clocks.items():
        steps = np.diff(clock.instants)
        gaps, repeats = np.flatnonzero(steps > 1), np.flatnonzero(steps < 1)
        if len(gaps):
            places = [f"{steps[gap] - 1} frame{'s' if steps[gap] > 2 else ''} after frame {gap}" for gap in gaps[:MOST_PLACES]]
            total = "" if len(gaps) == 1 else f"{int((steps[gaps] - 1).sum())} frames in {len(gaps)} places: "
            more = ", ..." if len(gaps) > MOST_PLACES else ""
            loss = f"lost {total}{', '.join(places)}{more}"
            yield f"camera '{name}' {loss}: its later frames are paired by their times, and it sees nothing in between."
        if len(repeats):
            crowded = f"{len(repeats)} frame{'s' if len(repeats) > 1 else ''}, first after frame {repeats[0]}, within half a frame of another one"
            yield f"camera '{name}': {crowded}: of two the nearer to its instant is used."
    uneven = {name: clock for name, clock in clocks.items() if clock.fps and _is_uneven(clock)}
    if uneven:
        # One sentence: cameras of one kind vary alike.
        worst = max(uneven.values(), key=lambda clock: abs(clock.errors).max())
        steps, farthest = 1e3 * worst.ordinary_s, float(abs(worst.errors).max())
        range_ms = f"{steps.min():.3g} to {steps.max():.3g} ms apart, {1e3 / worst.fps:.3g} on average"
        error = f"frames count as evenly spaced, which is wrong by at most {1e3 * farthest / worst.fps:.2g} ms ({farthest:.2g} of a frame)"
        yield f"The frame rate varies: frames of {', '.join(uneven)} are {range_ms}; {error}."


def _is_uneven(clock: VideoClock) -> bool:
    """Whether the times of frames are not those of an even rate, beyond the timestamps' rounding."""
    rounding, steps = clock.unit_s * clock.fps, clock.ordinary_s * clock.fps
    uneven = np.percentile(abs(steps - 1), 95) - rounding if len(steps) else 0.0
    return bool(uneven > UNEVEN or abs(clock.errors).max() - rounding > FAR)


def _describe_late_starts(clocks: Mapping[str, VideoClock], offsets: Mapping[str, int]) -> Iterator[str]:
    """Sentences on cameras whose first timestamp is later than that of others."""
    starts = {name: float(clock.times_s[0]) for name, clock in clocks.items() if clock.fps and len(clock.times_s)}
    for name, start in starts.items():
        late = round((start - min(starts.values())) * clocks[name].fps)
        if late and name not in offsets:
            problem = f"its first timestamp is {start:.3g} s, and that of others is {min(starts.values()):.3g} s"
            remedy = f"if this camera began to film {late} frame{'s' if late > 1 else ''} later, give --offset {name}=-{late}"
            yield f"camera '{name}': {problem}; first frames are paired with each other, whatever their timestamps: {remedy}."


def _describe_improbable(rates: Mapping[str, float]) -> Iterator[str]:
    improbable = {name: f"{rate:g}" for name, rate in rates.items() if rate > 0 and not SLOWEST <= rate < FASTEST}
    if improbable:
        states = f"{', '.join(dict.fromkeys(improbable.values()))} frames per second, by the timestamps of {', '.join(improbable)}"
        yield f"{states}, are improbable: if the cameras filmed at another rate, give it with --fps."


def _describe_drift(clocks: Mapping[str, VideoClock]) -> Iterator[str]:
    """A sentence if --fps makes equal what nearly is, and the difference grows to a part of a frame."""
    rates = {name: clock.fps for name, clock in clocks.items() if clock.fps}
    slowest, fastest = (choose(rates, key=lambda name: rates[name], default="") for choose in (min, max))
    if slowest and SAME_RATE < rates[fastest] / rates[slowest] - 1 < NEAR_RATE:
        frames = (rates[fastest] / rates[slowest] - 1) * min(len(clocks[name].times_s) for name in (slowest, fastest))
        difference = f"by their timestamps '{fastest}' and '{slowest}' are {frames:.2g} frames apart at the end"
        if frames > FAR:
            yield f"With --fps, frames are paired by their numbers, and {difference}; --resample pairs them by time."


def _describe_resampling(
    clocks: Mapping[str, VideoClock], frames: Mapping[str, tuple[Int[np.ndarray, " pair"], Int[np.ndarray, " pair"]]], slowest: float, asked: bool
) -> str:
    errors = [np.abs(_positions(clocks[name])[chosen] * (slowest / clocks[name].fps) - instants).max() for name, (instants, chosen) in frames.items()]
    listed = ", ".join(f"{name} {clock.fps:.6g}" for name, clock in clocks.items())
    how = "--resample:" if asked else "the rates drift apart in the recording:"
    error = f"the largest difference is {1e3 * max(errors) / slowest:.2g} ms ({max(errors):.2g} of a frame)"
    return f"Frames per second are {listed}; {how} at each instant of the slowest camera the nearest frames are paired; {error}."
