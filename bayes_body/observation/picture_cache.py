"""Pictures that took long to make, kept packed for whoever looks at them again."""

import threading
import zlib
from collections.abc import Callable, Hashable

import numpy as np
from jaxtyping import UInt8

type Picture = UInt8[np.ndarray, "row column"]
# Of a packed picture: its shape and its bytes.
type Packed = tuple[tuple[int, ...], bytes]


class PictureCache:
    """Up to so many bytes of the pictures of one owner; another owner's take their place. When it is full nothing more is kept.

    A recording is looked at from its first frame to its last, again and again: a shelf that gave up its oldest for its newest would be no use to it.
    """

    def __init__(self, most_bytes: int):
        self._most, self._lock = most_bytes, threading.Lock()
        self._owner: Hashable = None
        self._bytes, self._packed = 0, dict[Hashable, Packed | None]()

    def get(self, owner: Hashable, key: Hashable, make: Callable[[], Picture | None]) -> Picture | None:
        """The picture of that key, made where it is not there; one that was kept is read-only."""
        with self._lock:
            if owner != self._owner:
                self._owner, self._bytes, self._packed = owner, 0, {}
            found, packed = key in self._packed, self._packed.get(key)
        if found:
            return None if packed is None else np.frombuffer(zlib.decompress(packed[1]), np.uint8).reshape(packed[0])
        picture = make()
        self._keep(owner, key, None if picture is None else (picture.shape, zlib.compress(picture, 1)))
        return picture

    def _keep(self, owner: Hashable, key: Hashable, packed: Packed | None) -> None:
        size = 0 if packed is None else len(packed[1])
        with self._lock:
            if owner == self._owner and key not in self._packed and self._bytes + size <= self._most:
                self._bytes += size
                self._packed[key] = packed
