"""Work ahead of the consumer: in order, at once, within bounds; errors in their turn, and no thread after the end."""

import threading

import cv2
import pytest

from bayes_body.base.errors import InputError
from bayes_body.recording.observation import prefetch as module
from bayes_body.recording.observation.prefetch import prefetch, threads_for_work

PATIENCE_S = 300


@pytest.fixture(params=[1, 3])
def threads(request):
    return request.param


def test_order(threads):
    assert list(prefetch(range(20), lambda k: k * k, threads)) == [k * k for k in range(20)]
    assert list(prefetch([], lambda k: k, threads)) == []


def test_several_items_are_worked_on_at_once_while_the_consumer_works():
    meeting, workers = threading.Barrier(3), set()

    def compute(k: int) -> int:
        workers.add(threading.get_ident())
        # Three items meet here, or nobody passes.
        meeting.wait(PATIENCE_S)
        return k

    assert list(prefetch(range(6), compute, 3)) == list(range(6))
    assert len(workers) == 3 and threading.get_ident() not in workers


def test_items_are_drawn_by_one_thread_and_at_most_one_more_than_there_are_threads_is_ahead(threads):
    drawn, readers, next_drawn = [], set(), [threading.Event() for _ in range(20)]

    def items():
        for k in range(20):
            readers.add(threading.get_ident())
            drawn.append(k)
            next_drawn[k].set()
            yield k

    for k in prefetch(items(), lambda k: k, threads):
        assert next_drawn[min(k + threads + 1, 19)].wait(PATIENCE_S)
        assert len(drawn) <= k + threads + 2
    assert len(readers) == 1


def test_an_exception_comes_in_its_items_turn(threads):
    def compute(k: int) -> int:
        if k == 2:
            raise InputError("frame 2 is broken")
        return k

    results = prefetch(range(5), compute, threads)
    assert [next(results), next(results)] == [0, 1]
    with pytest.raises(InputError, match="frame 2 is broken"):
        next(results)


def test_an_exception_of_the_items_comes_in_its_turn(threads):
    def items():
        yield 0
        raise InputError("no more")

    results = prefetch(items(), lambda k: k, threads)
    assert next(results) == 0
    with pytest.raises(InputError, match="no more"):
        next(results)


def test_an_early_stop_leaves_no_thread_and_closes_the_items(threads):
    calls, closed = [], []

    def items():
        try:
            yield from range(1000)
        finally:
            closed.append(threading.current_thread().name)

    results = prefetch(items(), calls.append, threads)
    next(results)
    results.close()
    assert len(calls) <= threads + 2
    assert len(closed) == 1 and closed[0].startswith("prefetch-read")
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("prefetch")]


def test_opencv_keeps_its_threads_out_of_the_way():
    usual = cv2.getNumThreads()
    first, second = (prefetch(range(3), lambda _: cv2.getNumThreads(), 2) for _ in range(2))
    assert next(first) == next(second) == 1
    first.close()
    assert next(second) == 1
    second.close()
    assert cv2.getNumThreads() == usual


def test_as_many_threads_as_the_process_has_cores(monkeypatch):
    for cores, expected in ((1, 1), (2, 2), (64, module.MOST_THREADS)):
        monkeypatch.setattr(module, "core_count", lambda cores=cores: cores)
        assert threads_for_work() == expected
