"""The frames of a filter as a smoother reads them: from a last one back, each several times while the walks are near."""

from collections.abc import Iterator
from functools import lru_cache

from bayes_body.tracking.draws import FrameResult, Frames
from bayes_body.tracking.observations import PIECE

# Frames whose data are held for the runs that are behind.
HELD = 8
# Frames of the filter that are held: those near the walks, and those whose images are read ahead.
NEAR = HELD + 2 * PIECE


class Begun:
    """The first frames of a filter, up to a number of them."""

    def __init__(self, frames: Frames, count: int):
        self._frames, self._count = frames, count

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int, /) -> FrameResult:
        if not 0 <= index < self._count:
            raise IndexError(index)
        return self._frames[index]

    def __iter__(self) -> Iterator[FrameResult]:
        return (self[index] for index in range(self._count))


class Near:
    """The frames of a filter, of which the last ones that were asked for are held."""

    def __init__(self, frames: Frames):
        self._frames, self._held = frames, lru_cache(NEAR)(frames.__getitem__)

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int, /) -> FrameResult:
        return self._held(index)

    def __iter__(self) -> Iterator[FrameResult]:
        return iter(self._frames)
