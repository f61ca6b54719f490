"""How long after its last file a frame was stored, and how many frames waited then: a line of `live.csv` for each frame, and figures of all.

The figures begin when the tracker has caught up for the first time: before, frames wait because the program compiles.
"""

import time
from collections import deque
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bayes_body.results.storage.names import DELAYS_FILE

HEADER = "frame,delay_s,waiting"
# Seconds over which the rate of a moment is counted.
RATE_S = 1.0


class Delay(NamedTuple):
    """The moment after a frame was stored.

    Attributes:
        delay_s: seconds since the last camera's file of this frame appeared.
        waiting: number of later frames that were there already.
        stored_s: when that was, on the clock `time.monotonic`.
    """

    delay_s: float
    waiting: int
    stored_s: float


class Delays:
    """The delays of the frames of this process.

    Args:
        path: the file to which a line is added for each frame.
        first_frame: the number by which the user knows the run's first frame.
    """

    def __init__(self, path: Path, first_frame: int):
        self._path, self._first_frame = path, first_frame
        self._delays = list[Delay]()
        self._recent = deque[float]()

    def add(self, frame: int, appeared_s: float, waiting: int) -> None:
        """Note that a frame, counted from the run's first one, was stored now."""
        now_s = time.monotonic()
        self._delays.append(Delay(now_s - appeared_s, waiting, now_s))
        self._recent.append(now_s)
        while now_s - self._recent[0] > RATE_S:
            self._recent.popleft()
        is_new = not self._path.exists()
        with self._path.open("a", encoding="utf-8") as file:
            file.write(f"{HEADER}\n" * is_new + f"{self._first_frame + frame},{now_s - appeared_s:.4f},{waiting}\n")

    def latest(self) -> dict[str, float]:
        """The delay of the last frame, how many frames waited after it, and frames stored in the last second."""
        last = self._delays[-1]
        return {"delay_s": last.delay_s, "waiting": last.waiting, "frames_per_second": len(self._recent) / RATE_S}

    def figures(self) -> dict[str, Any]:
        """The figures of the frames from the first one after which none waited; of all frames if that was never so before the last one."""
        # After the last frame nothing waits in any case.
        caught_up = next((place for place, delay in enumerate(self._delays[:-1]) if not delay.waiting), None)
        counted = self._delays[caught_up or 0 :]
        if not counted:
            return {"frames": 0}
        delays_s = [delay.delay_s for delay in counted]
        duration_s = counted[-1].stored_s - counted[0].stored_s
        return {
            "frames": len(self._delays),
            "frames_until_caught_up": caught_up,
            "delay_s_median": float(np.median(delays_s)),
            "delay_s_95": float(np.quantile(delays_s, 0.95)),
            "frames_per_second": (len(counted) - 1) / duration_s if duration_s > 0 else None,
            "waiting_most": max(delay.waiting for delay in counted),
            "waiting_end": counted[-1].waiting,
        }


def delay_lines(figures: dict[str, Any]) -> list[str]:
    """Return lines for the user about the figures of `Delays.figures`, with `end` and `missing` of `ArrivingKeypoints`."""
    lines = [f"live       {figures['frames']} frames were tracked as they came; the recording ended because {figures['end']}"]
    if "delay_s_median" in figures:
        rate = f", {figures['frames_per_second']:.1f} frames a second" if figures["frames_per_second"] else ""
        until = figures["frames_until_caught_up"]
        since = "of all frames" if until is None else f"from the moment when the tracker had caught up, after {until + 1} frames"
        delay = f"median {figures['delay_s_median']:.3f} s, 95 % below {figures['delay_s_95']:.3f} s"
        lines.append(f"delay      {delay}{rate}, {since}; {DELAYS_FILE} has that of each frame")
        if figures["waiting_most"]:
            never = "the tracker never caught up: " if until is None else ""
            lines.append(f"waiting    {never}at most {figures['waiting_most']} frames waited, {figures['waiting_end']} at the end; none was left out")
    for camera, count in figures["missing"].items():
        lines.append(f"note: camera '{camera}': {count} frames have no file, or it came too late: it counts as having seen nothing there.")
    return lines
