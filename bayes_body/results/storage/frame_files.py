"""Frames on disk: each file is complete or missing, and a stored frame is not computed again.

`000057.npz` has the arrays of a frame and their digest (`storage.frame_arrays`), which depends on the digest of the frame before it. So a frame that
was changed, exchanged, copied or taken from another run is noticed. Once all draws of the first frames are in `posterior.nc`, an index replaces their
files (`storage.frame_archive`). A file comes before the index: a frame that was computed again replaces the one in the posterior.

If only some draws of a frame are stored, the last frame is stored with all its particles too, as `last_000057.npz`: the filters go on from them.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache
from io import BytesIO
from pathlib import Path

import numpy as np

from bayes_body.base.errors import InputError, escaped, input_error
from bayes_body.base.files.arrays_file import read_arrays
from bayes_body.base.files.atomic import make_folder, remove_partial, replacing, write_together
from bayes_body.results.storage.entries import Entries, Entry
from bayes_body.results.storage.frame_archive import (
    FrameArchive,
    Place,
    Stored,
    arrays_of,
    digest_of,
    in_posterior,
    place_of,
    read_archive,
    result_of,
)
from bayes_body.results.storage.names import POSTERIOR_FILE
from bayes_body.tracking.draws import FrameResult

# Readers go through the frames in order, and look back one frame.
KEPT_IN_MEMORY = 2
# Characters of a foreign id that a sentence shows.
SHOWN = 16
KIND, REMEDY = "a frame written by `bayes-body track`", "compute it again with --resume"
WHOLE = "the last frame with all its particles"

type Thinning = Callable[[FrameResult, int], FrameResult]
type Watch = Callable[[Sequence[int]], Iterable[int]]


def unwatched(frames: Sequence[int]) -> Iterable[int]:
    """Return the frames, without a progress bar."""
    return frames


class FrameFiles:
    """The frames of a folder, from the first one up to the first that is missing; each is read on demand.

    Args:
        folder: the folder of the files; it is made when the first frame is stored.
        run: the id of the run, which is stored with each frame. Frames with another id are refused; if it is empty, none are.
        thinning: what is stored of a frame, given its number; by default all of it.
    """

    def __init__(self, folder: Path, run: str = "", thinning: Thinning | None = None):
        self.folder, self.run, self.thinning = folder, run, thinning
        self._archive, self._damage = _archive_of(folder)
        self._count = self._count_frames()
        # The digest of the last frame, once it is known.
        self._last: str | None = None
        self._read = lru_cache(KEPT_IN_MEMORY)(self._load)
        # What the archive needs of the last frames, those that were stored by this object.
        self._entries = Entries()

    def path(self, index: int) -> Path:
        """Return the file of a frame."""
        return self.folder / f"{index:06d}.npz"

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int, /) -> FrameResult:
        """Return frame `index`, counted from the end if negative.

        Raises:
            IndexError: there is no such frame.
            InputError: its file is damaged, or belongs to another frame or run.
        """
        if not -self._count <= index < self._count:
            raise IndexError(index)
        return self._read(index % self._count).result

    def __iter__(self) -> Iterator[FrameResult]:
        return (self[index] for index in range(self._count))

    @property
    def last_digest(self) -> str:
        """The digest of the last frame, which depends on all frames before it; empty if there is none."""
        if self._last is None:
            self._last = self._read(self._count - 1).digest if self._count else ""
        return self._last

    @property
    def last(self) -> FrameResult:
        """The last frame with all its particles.

        Raises:
            InputError: only some of its particles are there, or the file is damaged.
        """
        result = self[-1]
        if not result.figures:
            return result
        path = self._whole_path(self._count - 1)
        stored_frame = load_frame(path) if path.exists() else None
        place = self._read(self._count - 1).place
        if stored_frame is None or stored_frame.place != place:
            problem = "missing" if stored_frame is None else "belongs to another frame or run"
            raise input_error(path, problem, WHOLE, "the run cannot go on: start again in another folder with --out")
        return stored_frame.result

    def append(self, result: FrameResult, /) -> None:
        """Store the next frame. It is on the disk when this function returns.

        Raises:
            InputError: the file system does not accept it.
        """
        number = self._count
        if not number:
            make_folder(self.folder)
        place, stored = Place(self.run, number, self.last_digest), result
        if self.thinning is not None:
            stored = self.thinning(result, number)
            save_frame(self._whole_path(number), result, place)
        self._last = save_frame(self.path(number), stored, place)
        self._entries.append(_entry_of(stored, self._last))
        if number:
            self._whole_path(number - 1).unlink(missing_ok=True)
        self._read.cache_clear()
        self._count += 1

    def extend(self, results: Sequence[FrameResult], /) -> None:
        """Store the next frames. All are on the disk when this function returns; to wait for all takes about as long as for one.

        Raises:
            InputError: the file system does not accept them. None counts then.
        """
        if self.thinning is not None or len(results) < 2:
            for result in results:
                self.append(result)
            return
        if not self._count:
            make_folder(self.folder)
        contents, entries, digest = dict[Path, bytes](), list[Entry](), self.last_digest
        for number, result in enumerate(results, self._count):
            content, digest = packed(result, Place(self.run, number, digest))
            contents[self.path(number)] = content
            entries.append(_entry_of(result, digest))
        write_together(contents)
        self._last = digest
        for entry in entries:
            self._entries.append(entry)
        self._read.cache_clear()
        self._count += len(results)

    def mend(self, watch: Watch = unwatched) -> str:
        """Prepare to continue: remove half-written files, read all frames, and end before the first that is damaged or in the wrong place.

        Args:
            watch: draws a progress bar.

        Returns:
            A sentence about the damage; empty if all frames are as they were stored. Files after the damaged one stay until their frames are stored
            again. A thinned run ends before its first frame, unless all particles of the frame before the damaged one are there.

        Raises:
            InputError: a frame belongs to another run. It is not replaced.
        """
        remove_partial(self.folder)
        damage = self._first_damage(watch)
        for path in self.folder.glob("last_*.npz"):
            if path != self._whole_path(self._count - 1):
                path.unlink(missing_ok=True)
        return damage

    def _first_damage(self, watch: Watch) -> str:
        previous_digest = ""
        for index in watch(range(self._count)):
            try:
                stored = self._stored(index)
            except InputError as damage:
                return self._end_before(index, str(damage))
            self._check_run(index, stored.place)
            if (stored.place.number, stored.place.before) != (index, previous_digest):
                problem = f"was stored as frame {stored.place.number} of this run, or after another frame"
                return self._end_before(index, str(input_error(self.path(index), problem, f"frame {index}", REMEDY)))
            previous_digest = stored.digest
        return self._damage

    def archive(self, last_first: bool = False, watch: Watch = unwatched) -> bool:
        """Remove the files of frames whose draws are all in the posterior, and return whether they are. Each frame is read back from there first.

        Args:
            last_first: whether the frames were stored from the last to the first.
            watch: draws a progress bar.

        Raises:
            InputError: a frame is damaged, or the file system does not accept the index.
        """
        files = [index for index in range(self._count) if self.path(index).exists()]
        if not files:
            return True
        first = self._stored(0)
        names = in_posterior(arrays_of(first.result, first.place))
        entries, first_stored = Entries(), self._count - len(self._entries)
        for index in range(self._count):
            entries.append(self._entries[index - first_stored] if index >= first_stored else self._entry(index))
        archive = FrameArchive(self.folder.parent / POSTERIOR_FILE, first.place.run, names, entries, last_first, trusted=True)
        try:
            for index in watch(range(self._count)):
                archive.load(index)
        except InputError:
            # A kernel of a plugin may have figures that the posterior does not have.
            return False
        archive.write(self.folder)
        self._archive = archive
        self._read.cache_clear()
        for index in files:
            self.path(index).unlink(missing_ok=True)
        return True

    def _whole_path(self, index: int) -> Path:
        return self.folder / f"last_{index:06d}.npz"

    def _count_frames(self) -> int:
        names = {path.name for path in self.folder.glob("*.npz")}
        count = 0
        while self.path(count).name in names or (self._archive is not None and count < len(self._archive)):
            count += 1
        return count

    def _end_before(self, index: int, damage: str) -> str:
        can_go_on = self.thinning is None or self._whole_path(index - 1).exists()
        self._count, self._last = index if can_go_on else 0, None
        self._entries = Entries()
        self._read.cache_clear()
        return damage

    def _stored(self, index: int) -> Stored:
        path = self.path(index)
        if self._archive is not None and index < len(self._archive) and not path.exists():
            return self._archive.load(index)
        return load_frame(path)

    def _load(self, index: int) -> Stored:
        stored = self._stored(index)
        self._check_run(index, stored.place)
        if stored.place.number != index:
            raise input_error(self.path(index), f"was stored as frame {stored.place.number}", f"frame {index}", REMEDY)
        return stored

    def _entry(self, index: int) -> Entry:
        stored = self._stored(index)
        return _entry_of(stored.result, stored.digest)

    def _check_run(self, index: int, place: Place) -> None:
        if self.run and place.run != self.run:
            remedy = "move the file away, or start a new run in another folder with --out"
            raise input_error(
                self.path(index), f"belongs to another run ('{escaped(place.run[:SHOWN])}')", f"a frame of this run ('{self.run}')", remedy
            )


def _entry_of(result: FrameResult, digest: str) -> Entry:
    return Entry(digest, result.seconds, result.seconds_ready, np.asarray(result.restarted, bool))


def _archive_of(folder: Path) -> tuple[FrameArchive | None, str]:
    """Return the archive of a folder, and a sentence if its index is damaged."""
    try:
        return read_archive(folder, folder.parent / POSTERIOR_FILE), ""
    except InputError as damage:
        return None, str(damage)


def save_frame(path: Path, result: FrameResult, place: Place) -> str:
    """Write one frame, either completely or not at all. Return its digest.

    Raises:
        InputError: the file system does not accept it.
    """
    content, digest = packed(result, place)
    with replacing(path) as partial:
        partial.write_bytes(content)
    return digest


def packed(result: FrameResult, place: Place) -> tuple[bytes, str]:
    """Return the content of a frame's file, and its digest."""
    arrays, file = arrays_of(result, place), BytesIO()
    digest = digest_of(arrays)
    np.savez(file, allow_pickle=False, **arrays, digest=np.asarray(digest))
    return file.getvalue(), digest


def load_frame(path: Path) -> Stored:
    """Read one frame, and verify its digest.

    Raises:
        InputError: the file is missing, truncated or damaged.
    """
    arrays = read_arrays(path, None, KIND, REMEDY)
    try:
        digest = str(arrays.pop("digest"))
        place, result = place_of(arrays), result_of(arrays)
    except (KeyError, TypeError, ValueError) as error:
        raise input_error(path, f"cannot be read ({type(error).__name__}: {error})", KIND, REMEDY) from None
    if digest != digest_of(arrays):
        raise input_error(path, "was changed since it was written (its digest is another)", KIND, REMEDY)
    return Stored(result, place, digest)
