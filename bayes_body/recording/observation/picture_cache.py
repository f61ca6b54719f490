"""A cache of compressed pictures that are expensive to compute."""

import threading
import zlib
from collections.abc import Callable, Hashable

import numpy as np
from jaxtyping import UInt8

type Picture = UInt8[np.ndarray, "row column"]
# A compressed picture: its shape and its bytes.
type Packed = tuple[tuple[int, ...], bytes]


class PictureCache:
    """At most so many bytes of the pictures of one owner; a new owner's pictures replace them. A full cache keeps no further pictures.

    A recording is read from its first frame to its last, several times. A cache that replaced its oldest picture by its newest would never have a
    hit.
    """

    def __init__(self, most_bytes: int):
        self._most, self._lock = most_bytes, threading.Lock()
        self._owner: Hashable = None
        self._bytes, self._packed = 0, dict[Hashable, Packed | None]()

    def get(self, owner: Hashable, key: Hashable, make: Callable[[], Picture | None]) -> Picture | None:
        """The picture of a key, computed if it is not cached; cached pictures are read-only."""
        with self._lock:
            if owner != self._owner:
                self._owner, self._bytes, self._packed = owner, 0, {}
            cached, packed = key in self._packed, self._packed.get(key)
        if cached:
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
