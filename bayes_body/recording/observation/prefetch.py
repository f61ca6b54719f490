"""Work ahead of the consumer: one thread draws the items in their order, and as many threads as there are cores work on them.

OpenCV, PyAV and NumPy do most of their work without Python's lock, so threads are enough. Items are drawn by one thread because a video must be read
onwards. What is made of an item depends on it alone, so the number of threads makes no difference to the results.
"""

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, nullcontext

import cv2

from bayes_body.base.config import core_count
from bayes_body.base.shared_setting import SharedSetting

# More threads would wait for Python's lock.
MOST_THREADS = 8
# OpenCV works in the calling threads alone: its own would take the cores from them, and from the device.
ONE_OPENCV_THREAD = SharedSetting(cv2.getNumThreads, cv2.setNumThreads, 1)


def threads_for_work() -> int:
    """The number of threads that work: as many as the cores that this process may use, at most 8."""
    return min(core_count(), MOST_THREADS)


def prefetch[Item, Result](items: Iterable[Item], function: Callable[[Item], Result], threads: int | None = None) -> Generator[Result, None, None]:
    """Yield `function(item)` for each item, in order, computed ahead while the consumer works.

    An exception in the function or in `items` is raised when its item's turn comes. If the consumer stops early, it waits for the items in progress.

    Args:
        items: drawn one after the other by one thread, and closed by it if they are a generator.
        function: called for several items at once.
        threads: how many at once; by default `threads_for_work()`. At most so many items and one are ahead of the consumer.
    """
    threads = threads or threads_for_work()
    remaining, end = iter(items), object()

    def work(drawing: Future[Item | object]) -> Result | object:
        item = drawing.result()
        return end if item is end else function(item)  # pyright: ignore[reportArgumentType]

    with (
        nullcontext() if threads == 1 else ONE_OPENCV_THREAD,
        _closed_by_its_thread(remaining) as reader,
        ThreadPoolExecutor(threads, thread_name_prefix="prefetch") as pool,
    ):
        pending = deque[tuple[Future[Item | object], Future[Result | object]]]()

        def submit() -> None:
            # A StopIteration cannot pass through a future into a generator.
            drawing = reader.submit(next, remaining, end)
            pending.append((drawing, pool.submit(work, drawing)))

        try:
            for _ in range(threads + 1):
                submit()
            while (result := pending.popleft()[1].result()) is not end:
                submit()
                yield result  # pyright: ignore[reportReturnType]
        finally:
            # First the work, which would wait for its item.
            for future in [working for _, working in pending] + [drawing for drawing, _ in pending]:
                future.cancel()


@contextmanager
def _closed_by_its_thread(items: Iterator[object]) -> Iterator[ThreadPoolExecutor]:
    """A thread that draws items, and closes them if they are a generator."""
    with ThreadPoolExecutor(1, thread_name_prefix="prefetch-read") as reader:
        try:
            yield reader
        finally:
            if isinstance(items, Generator):
                reader.submit(items.close)
