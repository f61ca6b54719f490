r"""C3D, the binary format of motion laboratories (c3d.org), written with ezc3d: millimetres, 32-bit floats.

The points are the markers' means. A point's residual, which usually measures the agreement of the cameras, is the posterior's standard deviation: the
root of the mean variance of the three axes, $\sqrt{(s_x^2 + s_y^2 + s_z^2)/3}$. A C3D residual is a byte, of which seven bits are used, in steps of
|POINT:SCALE| mm. On request, the moments of each axis are stored in full precision as further points, with `_sd`, `_q05` and `_q95` after the
marker's name. The file of a mode seeker's run has the means only, and its residuals are 0. A point without a number is missing: its residual is -1.

The format's description (C3D user guide, "Notes for programmers, floating-point 3D data") has the residual in the low byte of a point's fourth word,
and the cameras that saw the point in the high byte. The scale is in the header and in POINT:SCALE. ezc3d 1.7 writes the residual into the high byte,
and -1 as the header's scale. Both are corrected in the file that it wrote. ezc3d also reads the high byte, and so it reads a residual of 0.

The gait events of a smoothed run are in the groups EVENT and EVENT_CONTEXT (C3D user guide), as motion laboratories' programs write and read them. An
event has a label, a context (`Left` or `Right`) and a time from the first frame: minutes and seconds. The time is the posterior's mean. The
description says how certain it is, since the format has no other place for that.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from bayes_body.base.errors import input_error
from bayes_body.base.files.atomic import replacing
from bayes_body.results.clinical.gait import Event
from bayes_body.results.posterior.moments import Moments
from bayes_body.view.export.motion import LongMotion, Motion

LABELS = {"foot strike": "Foot Strike", "toe off": "Foot Off"}
# Symbols of the labels.
ICONS = {"foot strike": 1, "toe off": 2}
CONTEXTS = {"l": "Left", "r": "Right"}
# An event that fewer of the draws have is not written.
LEAST_SHARE = 0.5
# A parameter has at most so many entries; the next ones are in LABELS2 and so on, as those of POINT.
MOST_ENTRIES = 255
MINUTE_S = 60.0


def written_events(events: Sequence[Event]) -> list[Event]:
    """Return the events that a file has: those that at least half of the draws have."""
    return [event for event in events if event.share >= LEAST_SHARE]


def add_events(c3d: Any, events: Sequence[Event]) -> None:
    """Add the groups to a document of ezc3d; nothing without events."""
    entries = written_events(events)
    if not entries:
        return
    _add_integers(c3d, "EVENT", "USED", [len(entries)])
    for first in range(0, len(entries), MOST_ENTRIES):
        number = first // MOST_ENTRIES + 1
        _add_piece(c3d, entries[first : first + MOST_ENTRIES], "" if number == 1 else str(number))
    _add_integers(c3d, "EVENT_CONTEXT", "USED", [len(CONTEXTS)])
    _add_integers(c3d, "EVENT_CONTEXT", "ICON_IDS", list(range(1, len(CONTEXTS) + 1)))
    c3d.add_parameter("EVENT_CONTEXT", "LABELS", list(CONTEXTS.values()))
    c3d.add_parameter("EVENT_CONTEXT", "DESCRIPTIONS", [f"{side} side" for side in CONTEXTS.values()])


def _add_piece(c3d: Any, events: Sequence[Event], ending: str) -> None:
    seconds = np.array([np.nanmean(event.times) for event in events])
    c3d.add_parameter("EVENT", f"CONTEXTS{ending}", [CONTEXTS[event.side] for event in events])
    c3d.add_parameter("EVENT", f"LABELS{ending}", [LABELS[event.kind] for event in events])
    c3d.add_parameter("EVENT", f"DESCRIPTIONS{ending}", [_certainty(event) for event in events])
    # The event belongs to the only person.
    c3d.add_parameter("EVENT", f"SUBJECTS{ending}", [" "] * len(events))
    c3d.add_parameter("EVENT", f"TIMES{ending}", np.stack([seconds // MINUTE_S, seconds % MINUTE_S]))
    _add_integers(c3d, "EVENT", f"ICON_IDS{ending}", [ICONS[event.kind] for event in events])
    _add_integers(c3d, "EVENT", f"GENERIC_FLAGS{ending}", [0] * len(events))


def _certainty(event: Event) -> str:
    times = event.times[np.isfinite(event.times)]
    low, high = np.quantile(times, (0.05, 0.95))
    share = f", in {event.share:.0%} of the draws" if event.share < 1 else ""
    return f"sd {1000 * times.std():.0f} ms, 90 % {low:.3f} to {high:.3f} s{share}"


def _add_integers(c3d: Any, group: str, name: str, values: list[int]) -> None:
    """Add a parameter of 16-bit integers, which ezc3d's `add_parameter` would make floats."""
    from ezc3d.ezc3d import Parameter, VecInt

    parameter = Parameter(name, "")
    parameter.set(VecInt(values), [len(values)])
    c3d["parameters"].add_parameter(group, parameter)


MILLIMETRES = 1000.0
# Largest number of steps (readers may take the byte as signed), and the smallest useful step, mm.
LARGEST_STEP, FINEST = 127, 0.01
# The residual of a missing point, whose position is 0.
MISSING = -1
# Places in the header: the scale, and the number of the first block of data. Size of a block, bytes.
SCALE, FIRST_BLOCK, BLOCK = slice(12, 16), slice(16, 18), 512
# The format counts frames in 16 bits.
MOST_FRAMES = 65535
MODE_SEEKER_MEANING = "mean of a mode seeker's particles, without uncertainty"
MEANINGS = {
    "mean": "posterior mean; residual: posterior sd, root mean square of the axes",
    "sd": "posterior standard deviation of each axis, not a position",
    "q05": "5 % quantile of each axis",
    "q95": "95 % quantile of each axis",
}


def write_c3d(motion: Motion | LongMotion, path: Path, spread: bool = False) -> None:
    """Write the file.

    Args:
        motion: the motion of a run.
        path: the file.
        spread: whether to write standard deviation and quantiles of each axis as further points.

    Raises:
        InputError: there are more frames than the format can count, or the file system does not accept the file.
    """
    if motion.frames > MOST_FRAMES:
        raise input_error("--to c3d", f"{motion.frames} frames", f"at most {MOST_FRAMES}, the format's limit", "choose npz, csv or trc")
    # The format counts so few frames that they fit in memory.
    motion, moments = motion.in_memory, motion.moments if spread else ("mean",)
    residuals, step = _residuals(motion, moments)
    with replacing(path) as partial:
        # ezc3d appends its ending to any other.
        draft = partial.with_name(f"{partial.name}.c3d")
        try:
            _document(motion, moments, step).write(str(draft))
            partial.write_bytes(_with_residuals(draft.read_bytes(), residuals, step))
        finally:
            draft.unlink(missing_ok=True)


def _document(motion: Motion, moments: Sequence[str], step: float) -> Any:
    import ezc3d

    c3d = ezc3d.c3d()
    points = c3d["parameters"]["POINT"]
    points["UNITS"]["value"] = ["mm"]
    points["RATE"]["value"] = [motion.fps]
    points["SCALE"]["value"] = [-step]
    points["LABELS"]["value"] = [f"{marker}{'' if name == 'mean' else f'_{name}'}" for name in moments for marker in motion.marker_names]
    points["DESCRIPTIONS"]["value"] = [_meaning(name, motion) for name in moments for _ in motion.marker_names]
    c3d["data"]["points"] = _points(motion.markers, moments)
    c3d.add_parameter("POINT", "X_SCREEN", ["+Y" if motion.up == "x" else "+X"])
    c3d.add_parameter("POINT", "Y_SCREEN", [f"+{motion.up.upper()}"])
    add_events(c3d, motion.events)
    return c3d


def _meaning(name: str, motion: Motion) -> str:
    return MEANINGS[name] if motion.has_intervals else MODE_SEEKER_MEANING


def _points(markers: Moments, moments: Sequence[str]) -> Float[np.ndarray, "4 point frame"]:
    sets = np.concatenate([getattr(markers, name) for name in moments], axis=1)
    points = np.ones((4, sets.shape[1], sets.shape[0]))
    points[:3] = MILLIMETRES * np.where(_missing(sets)[..., None], 0.0, sets).transpose(2, 1, 0)
    return points


def _missing(positions: Float[np.ndarray, "frame point 3"]) -> Bool[np.ndarray, "frame point"]:
    return ~np.isfinite(positions).all(axis=-1)


def _residuals(motion: Motion, moments: Sequence[str]) -> tuple[Int[np.ndarray, "frame point"], float]:
    """Return the residuals in steps, and the smallest possible step, millimetres, to which the format rounds them.

    There are points of each of the `moments`; only those of the first, the mean, have a residual that is not 0. A missing point has -1.
    """
    markers = motion.markers
    sd = MILLIMETRES * np.sqrt((markers.sd**2).mean(axis=-1)) if motion.has_intervals else np.zeros(markers.mean.shape[:2])
    sd[~np.isfinite(sd)] = 0
    step = max(math.ceil(sd.max(initial=0) / (LARGEST_STEP - 1) / FINEST) * FINEST, FINEST)
    steps = np.zeros((len(sd), len(moments) * sd.shape[1]), int)
    steps[:, : sd.shape[1]] = np.round(sd / step)
    steps[_missing(np.concatenate([getattr(markers, name) for name in moments], axis=1))] = MISSING
    return steps, step


def _with_residuals(content: bytes, residuals: Int[np.ndarray, "frame point"], step: float) -> bytearray:
    """Return a file of ezc3d with the residuals and the scale where the format has them."""
    frames, points = residuals.shape
    corrected = bytearray(content)
    start = (int.from_bytes(content[FIRST_BLOCK], "little") - 1) * BLOCK
    words = np.frombuffer(corrected, "<f4", 4 * points * frames, start).reshape(frames, points, 4)
    words[..., 3] = residuals
    corrected[SCALE] = np.array(-step, "<f4").tobytes()
    return corrected
