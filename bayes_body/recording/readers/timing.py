"""Align the cameras' frames: cameras may start at different times, number their frames differently and have different lengths."""

from collections.abc import Mapping
from typing import NamedTuple

from bayes_body.base.errors import InputError, input_error, nearest
from bayes_body.recording.readers.faults import Faults

# Two videos with the same rate; their containers round it differently.
SAME_RATE = 5e-4


class Timing(NamedTuple):
    """The session's frames: their count, the number of the first, each camera's offset by name, and remarks for the user."""

    frames: int
    first_frame: int
    offsets: dict[str, int]
    remarks: list[str]


def align(counts: Mapping[str, tuple[int, int]], offsets: Mapping[str, int]) -> Timing:
    """The frames that all cameras have.

    Args:
        counts: each camera's first frame number and number of frames.
        offsets: how many frames a camera is ahead, for some of the cameras. The session starts where the last camera starts.

    Raises:
        FaultyFileError: an offset for an unknown camera, or no frame that all cameras have.
    """
    faults = Faults()
    for name in offsets:
        with faults.collect():
            if name not in counts:
                raise InputError(f"--offset: '{name}': no such camera; {nearest(name, counts)}")
    faults.raise_any()
    latest = max(0, -min((offsets.get(name, 0) for name in counts), default=0))
    skipped = {name: latest + offsets.get(name, 0) for name in counts}
    remaining = {name: count - skipped[name] for name, (_, count) in counts.items()}
    frames = min(remaining.values())
    if frames < 1:
        name = min(remaining, key=lambda camera: remaining[camera])
        raise input_error(
            f"camera '{name}'", f"{counts[name][1]} frames, all before the session's first", "frames that all cameras have", "correct --offset"
        )
    starts = {name: first + skipped[name] for name, (first, _) in counts.items()}
    first_frame = min(starts.values())
    return Timing(frames, first_frame, {name: start - first_frame for name, start in starts.items()}, _remarks(remaining, frames, latest))


def _remarks(remaining: Mapping[str, int], frames: int, latest: int) -> list[str]:
    remarks = []
    if latest:
        remarks.append(f"The session starts {latest} frames into the recording, where the camera with the smallest offset does.")
    if max(remaining.values()) > frames:
        listed = ", ".join(f"{name} {count}" for name, count in remaining.items())
        remarks.append(f"Cameras have different numbers of frames ({listed}): the session has the {frames} that all have.")
    return remarks


def frame_rate(rates: Mapping[str, float], user_rate: float | None) -> tuple[float, list[str]]:
    """The session's frame rate (frames per second), and remarks.

    Args:
        rates: each camera's rate, 0 if its recording does not state it.
        user_rate: the user's rate; overrides the videos' rates.

    Raises:
        InputError: no rate is known, or the cameras differ.
    """
    known = {name: rate for name, rate in rates.items() if rate > 0}
    if user_rate is not None:
        others = [f"{name} {rate:g}" for name, rate in known.items() if abs(rate - user_rate) > SAME_RATE * user_rate]
        return user_rate, [f"--fps {user_rate:g} overrides the videos' rates ({', '.join(others)})."] if others else []
    if not known:
        raise input_error(
            "--fps",
            "not given, and no recording states its frame rate",
            "frames per second",
            "give the rate at which the cameras filmed, such as --fps 60",
        )
    slowest, fastest = min(known.values()), max(known.values())
    if fastest - slowest > SAME_RATE * fastest:
        listed = ", ".join(f"{name} {rate:g}" for name, rate in known.items())
        raise input_error("frame rate", f"cameras differ: {listed}", "one rate", "convert the videos to one rate, or give the true one with --fps")
    # Containers round the rate, so the mean is nearer to the truth than any single camera's.
    return round(sum(known.values()) / len(known), 6), []
