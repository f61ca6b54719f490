"""Which unit begins next.

The first unit of a shape compiles its programs. Others of that shape wait until it has stored a frame, and take the programs from the cache. A
closing unit comes before all others, so that sessions are finished one after the other.
"""

import heapq
from collections import defaultdict
from collections.abc import Iterable

from bayes_body.runs.study.units import Unit


class UnitQueue:
    """The units that are not done yet, in the order in which they may begin.

    Args:
        units: all units that must run, in the order of the study.
        done: keys of those that are done already.
    """

    def __init__(self, units: Iterable[Unit], done: Iterable[str]):
        self._order = {unit.key: number for number, unit in enumerate(units)}
        self._units = {unit.key: unit for unit in units}
        self._ready: dict[str, list[tuple[bool, int, str]]] = defaultdict(list)
        self._compiling: dict[str, str] = {}
        self._compiled: set[str] = set()
        done = set(done)
        self._missing = {unit.key: set(unit.needs) - done for unit in units}
        self._waiting = defaultdict(list)
        for unit in units:
            for key in self._missing[unit.key]:
                self._waiting[key].append(unit.key)
            if not self._missing[unit.key]:
                self.put(unit)

    def put(self, unit: Unit) -> None:
        """Let a unit begin as soon as its shape is compiled."""
        heapq.heappush(self._ready[unit.shape], (not unit.is_closing, self._order[unit.key], unit.key))

    def take(self) -> tuple[Unit, bool] | None:
        """Return the next unit, and whether it is the first of its shape; None if none may begin now."""
        open_shapes = [shape for shape, heap in self._ready.items() if heap and shape not in self._compiling]
        if not open_shapes:
            return None
        shape = min(open_shapes, key=lambda name: self._ready[name][0])
        _, _, key = heapq.heappop(self._ready[shape])
        is_first = shape not in self._compiled
        if is_first:
            self._compiling[shape] = key
        return self._units[key], is_first

    @property
    def compiling(self) -> list[Unit]:
        """The running units for which others of their shape wait."""
        return [self._units[key] for key in self._compiling.values()]

    def has_compiled(self, unit: Unit) -> None:
        """Let the other units of a shape begin."""
        self._compiled.add(unit.shape)
        self._compiling.pop(unit.shape, None)

    def leave(self, unit: Unit, is_done: bool, is_over: bool) -> None:
        """Note that a unit has ended.

        Args:
            unit: the unit.
            is_done: whether units that need it may begin.
            is_over: whether it does not begin again. Others of its shape do not wait any longer then, even if it has failed.
        """
        if self._compiling.get(unit.shape) == unit.key:
            del self._compiling[unit.shape]
        if is_over:
            self._compiled.add(unit.shape)
        if not is_done:
            return
        for key in self._waiting.pop(unit.key, []):
            self._missing[key].discard(unit.key)
            if not self._missing[key]:
                self.put(self._units[key])

    def __bool__(self) -> bool:
        """Whether a unit is ready, now or once its shape is compiled."""
        return any(self._ready.values())
