"""Compiled programs on disk, each stored with a digest of its key and content. JAX itself trusts a file's name.

If two files of JAX's cache are exchanged, JAX runs the wrong program: an internal error, or other numbers. Here an entry that does not fit its key
counts as missing, and the program is compiled again.
"""

import hashlib
from pathlib import Path
from typing import Protocol

DIGEST_BYTES = 32
# How many programs of this process came from the cache, and how many had to be compiled.
LOOKUPS = {"hits": 0, "misses": 0}


class Files(Protocol):
    """JAX's own cache (its `CacheInterface`): bytes under keys, in a folder."""

    _path: Path

    def get(self, key: str) -> bytes | None:
        """The bytes of a key."""
        ...

    def put(self, key: str, value: bytes) -> None:
        """Store bytes, unless there are some under that key."""
        ...


class CheckedPrograms:
    """A cache of JAX whose entries begin with a digest.

    Args:
        files: where they are stored.
    """

    def __init__(self, files: Files):
        self._files = files
        self._path = files._path

    def get(self, key: str) -> bytes | None:
        """The program of a key; None if there is none, or if its entry is damaged or belongs to another key."""
        program = self._checked(key)
        LOOKUPS["misses" if program is None else "hits"] += 1
        return program

    def _checked(self, key: str) -> bytes | None:
        entry = self._files.get(_name(key))
        if entry is None:
            return None
        digest, program = entry[:DIGEST_BYTES], entry[DIGEST_BYTES:]
        if digest == _digest(key, program):
            return program
        # JAX does not overwrite an entry: without this, the program would be compiled each time.
        (Path(self._path) / f"{_name(key)}-cache").unlink(missing_ok=True)
        return None

    def put(self, key: str, value: bytes) -> None:
        """Store a program."""
        self._files.put(_name(key), _digest(key, value) + value)


def _name(key: str) -> str:
    # Other programs may use the same folder through JAX alone, which could not read an entry with a digest.
    return f"{key}-checked"


def _digest(key: str, program: bytes) -> bytes:
    return hashlib.blake2b(program, digest_size=DIGEST_BYTES, key=hashlib.sha256(key.encode()).digest()).digest()


def check_programs() -> None:
    """Let JAX use `CheckedPrograms` from now on. It must not have compiled anything yet."""
    # JAX has no public way to choose its cache.
    from jax._src import compilation_cache

    make = compilation_cache.get_file_cache
    if make.__module__ == __name__:
        return

    def checked(path: str) -> tuple[CheckedPrograms, str] | None:
        made = make(path)
        return None if made is None else (CheckedPrograms(made[0]), made[1])

    compilation_cache.get_file_cache = checked
