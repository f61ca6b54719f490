"""A session's frames: what all cameras saw at one instant, and reading ahead of whoever works on them."""

from collections.abc import Callable, Generator, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bayes_body.errors import wrong
from bayes_body.recording.images import read_grey, read_mask
from bayes_body.session import Session


class Frame(NamedTuple):
    """One instant, an entry for each view: `images` (height, width) of grey values, `masks` (height, width), or None where the session has none."""

    index: int  # pyright: ignore[reportIncompatibleMethodOverride]
    images: tuple[NDArray[np.uint8], ...]
    masks: tuple[NDArray[np.bool_], ...] | None


def read_frame(session: Session, index: int) -> Frame:
    """Frame `index` of a session, counted from 0.

    Raises:
        InputError: no such frame; an image is missing, cut short or not of its camera's size.
    """
    if not 0 <= index < session.frames:
        raise wrong(session.title, f"frame {index}", f"0 to {session.frames - 1}", "choose a frame of the session")
    images = tuple(read_grey(session.image_path(view, index), view.camera.size_px) for view in session.views)
    masks = []
    for view in session.views:
        path = session.mask_path(view, index)
        if path is None:
            return Frame(index, images, None)
        masks.append(read_mask(path, view.camera.size_px))
    return Frame(index, images, tuple(masks))


def prefetch[Item, Result](items: Iterable[Item], function: Callable[[Item], Result]) -> Generator[Result, None, None]:
    """`function(item)` of each item, in order; the next one is computed in a background thread while the consumer works on this one.

    An exception, of the function or of `items`, reaches the consumer in its item's turn. One that stops early waits for the item under way.
    """
    remaining = iter(items)
    end = object()

    def following() -> Result | object:
        # A StopIteration would not pass through a future into a generator.
        item = next(remaining, end)
        return end if item is end else function(item)  # pyright: ignore[reportArgumentType]

    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="prefetch") as pool:
        pending = pool.submit(following)
        while (result := pending.result()) is not end:
            pending = pool.submit(following)
            yield result  # pyright: ignore[reportReturnType]
