"""Which of a camera's own frames are the session's: cameras that started at different times, counted from different numbers, of different lengths."""

from collections.abc import Mapping
from typing import NamedTuple

from bayes_body.errors import InputError, input_error, nearest
from bayes_body.recording.faults import Faults

# Two videos of one rate: their containers round it differently.
SAME_RATE = 5e-4


class Timing(NamedTuple):
    """The session's frames: how many, the number of the first, each camera's offset from it, by name, and remarks for the user."""

    frames: int
    first_frame: int
    offsets: dict[str, int]
    remarks: list[str]


def align(counts: Mapping[str, tuple[int, int]], offsets: Mapping[str, int]) -> Timing:
    """The frames that all cameras have.

    Args:
        counts: each camera's first number and how many frames it has.
        offsets: frames by which a camera is ahead, for some of the cameras; the session starts where the last camera does.

    Raises:
        FaultyFileError: offsets of cameras that are not there, or no frame that all cameras have.
    """
    faults = Faults()
    for name in offsets:
        with faults.collect():
            if name not in counts:
                raise InputError(f"--offset: '{name}': no such camera; {nearest(name, counts)}")
    faults.raise_any()
    latest = max(0, -min((offsets.get(name, 0) for name in counts), default=0))
    skipped = {name: latest + offsets.get(name, 0) for name in counts}
    left = {name: count - skipped[name] for name, (_, count) in counts.items()}
    frames = min(left.values())
    if frames < 1:
        name = min(left, key=lambda each: left[each])
        raise input_error(
            f"camera '{name}'", f"{counts[name][1]} frames, all before the session's first", "frames that all cameras have", "correct --offset"
        )
    starts = {name: first + skipped[name] for name, (first, _) in counts.items()}
    first_frame = min(starts.values())
    return Timing(frames, first_frame, {name: start - first_frame for name, start in starts.items()}, _remarks(left, frames, latest))


def _remarks(left: Mapping[str, int], frames: int, latest: int) -> list[str]:
    remarks = []
    if latest:
        remarks.append(f"The session starts {latest} frames into the recording, where the camera with the smallest offset does.")
    if max(left.values()) > frames:
        listed = ", ".join(f"{name} {count}" for name, count in left.items())
        remarks.append(f"Cameras have different numbers of frames ({listed}): the session has the {frames} that all have.")
    return remarks


def frame_rate(rates: Mapping[str, float], given: float | None) -> tuple[float, list[str]]:
    """Frames a second of the session, and remarks.

    Args:
        rates: of each camera, 0 where its recording does not say.
        given: by the user; it goes before what the videos say.

    Raises:
        InputError: nobody says it, or cameras differ.
    """
    said = {name: rate for name, rate in rates.items() if rate > 0}
    if given is not None:
        others = [f"{name} {rate:g}" for name, rate in said.items() if abs(rate - given) > SAME_RATE * given]
        return given, [f"--fps {given:g} goes before what videos say ({', '.join(others)})."] if others else []
    if not said:
        raise input_error(
            "--fps", "not given, and no recording says its frame rate", "frames a second", "say at which rate the cameras filmed, such as --fps 60"
        )
    slowest, fastest = min(said.values()), max(said.values())
    if fastest - slowest > SAME_RATE * fastest:
        listed = ", ".join(f"{name} {rate:g}" for name, rate in said.items())
        raise input_error("frame rate", f"cameras differ: {listed}", "one rate", "convert the videos to one rate, or say the true one with --fps")
    # Containers round: 59.94 is nearer to the truth than any one camera's.
    return round(sum(said.values()) / len(said), 6), []
