"""Gait events in a C3D file: its groups EVENT and EVENT_CONTEXT (C3D user guide), as motion laboratories' programs write and read them.

An event has a label, a context (`Left` or `Right`) and a time from the first frame: minutes and seconds. The time is the posterior's mean. The
description says how certain it is, since the format has no other place for that.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from bayes_body.results.clinical.gait import Event

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
    known = event.times[np.isfinite(event.times)]
    low, high = np.quantile(known, (0.05, 0.95))
    share = f", in {event.share:.0%} of the draws" if event.share < 1 else ""
    return f"sd {1000 * known.std():.0f} ms, 90 % {low:.3f} to {high:.3f} s{share}"


def _add_integers(c3d: Any, group: str, name: str, values: list[int]) -> None:
    """Add a parameter of 16-bit integers, which ezc3d's `add_parameter` would make floats."""
    from ezc3d.ezc3d import Parameter, VecInt

    parameter = Parameter(name, "")
    parameter.set(VecInt(values), [len(values)])
    c3d["parameters"].add_parameter(group, parameter)
