"""A look at a strange HDF5 file, by a process of its own: `python -m bayes_body.results.storage.hdf5_screen FILE`.

HDF5 is a library in C. A file that somebody prepared can make it read other files, fill the memory, or never end. The process has a limit of memory,
and its parent a limit of time. It follows every path that a reader of a posterior would take, and prints what is wrong.
"""

import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

    import h5py

SECONDS, MEMORY_BYTES = 60, 4 * 2**30
# A slow disk reads so many bytes a second.
SLOWEST_BYTES = 10_000_000
# Arrays that were never written take no room in the file. A posterior has a few small ones: dimensions without coordinates.
SLACK_BYTES = 2**20


def screened(path: Path) -> str:
    """Return what is wrong with a file, as the middle of a sentence; empty if it is a plain HDF5 file whose checksums are right."""
    # The module has no imports of the package, so that the process starts fast.
    command = [sys.executable, "-I", str(Path(__file__)), str(path)]
    seconds = SECONDS + path.stat().st_size / SLOWEST_BYTES
    try:
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=seconds, check=False, stdin=subprocess.DEVNULL)
    except subprocess.TimeoutExpired:
        return f"HDF5 did not finish reading it within {seconds:.0f} s"
    if done.returncode < 0:
        return f"HDF5 ended with signal {-done.returncode} when reading it"
    return done.stdout.strip() if done.returncode == 0 else "damaged, HDF5 cannot read it"


def first_fault(path: Path) -> str:
    """Return the first thing that is wrong with a file; empty if nothing is."""
    import h5py

    with h5py.File(path, "r") as file:
        return next(_faults(file, path.stat().st_size), "")


def _faults(file: "h5py.File", size: int) -> "Iterator[str]":
    import h5py

    groups: list[h5py.Group] = [file]
    visited, arrays = {file.id.__hash__()}, 0
    while groups:
        group = groups.pop()
        for name in group:
            if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                yield f"the entry {name!a} is a link to elsewhere"
            entry = group[name]
            list(entry.attrs.items())
            if isinstance(entry, h5py.Group):
                if entry.id.__hash__() in visited:
                    yield f"the group {name!a} occurs twice"
                visited.add(entry.id.__hash__())
                groups.append(entry)
            elif isinstance(entry, h5py.Dataset):
                arrays += entry.nbytes
                if arrays > 2 * size + SLACK_BYTES:
                    yield f"{arrays} bytes of arrays in a file of {size}"
                yield from _of_array(entry, str(name))
                _read(entry)


def _of_array(array: "h5py.Dataset", name: str) -> "Iterator[str]":
    import h5py

    if array.external or array.is_virtual:
        yield f"the array {name!a} lies in another file"
    if array.dtype.hasobject and h5py.check_string_dtype(array.dtype) is None:
        yield f"the array {name!a} holds objects"
    used = {array.compression, *(filter_name for filter_name in ("shuffle", "fletcher32", "scaleoffset") if getattr(array, filter_name))} - {None}
    if array.id.get_create_plist().get_nfilters() != len(used):
        yield f"the array {name!a} needs a filter that is not built in"


def _read(array: "h5py.Dataset") -> None:
    """Read an array piece by piece, so that HDF5 verifies its checksums."""
    if array.chunks:
        for chunk in array.iter_chunks():
            array[chunk]
    else:
        array[()]


def main() -> None:
    """Print the first fault, within a limit of memory where the system has one."""
    try:
        import resource
    except ImportError:
        pass
    else:
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    print(first_fault(Path(sys.argv[1])))


if __name__ == "__main__":
    main()
