"""A setting of a library that holds for the whole process, changed while any thread needs it so."""

import threading
from collections.abc import Callable
from types import TracebackType


class SharedSetting[Value]:
    """A `with` block in which the setting has a value. It gets its usual value back when the last block of all threads ends.

    Args:
        read: returns the setting.
        write: changes it.
        value: what it is within the block.
    """

    def __init__(self, read: Callable[[], Value], write: Callable[[Value], object], value: Value):
        self._read, self._write, self._value = read, write, value
        self._lock, self._blocks, self._usual = threading.Lock(), 0, value

    def __enter__(self) -> None:
        """Change the setting, unless another block did."""
        with self._lock:
            if not self._blocks:
                self._usual = self._read()
                self._write(self._value)
            self._blocks += 1

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Change it back, unless another block still needs it."""
        with self._lock:
            self._blocks -= 1
            if not self._blocks:
                self._write(self._usual)
