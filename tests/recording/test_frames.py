"""Frames of a session, and reading ahead."""

import threading
import time

import pytest

from bayes_body.errors import InputError
from bayes_body.observation.frames import prefetch, read_frame
from bayes_body.recording.parsec import import_parsec


def test_real_frames(bodytrack, tmp_path):
    session, _ = import_parsec(bodytrack, tmp_path)
    frame = read_frame(session, 3)
    assert frame.index == 3
    assert frame.masks is not None
    assert len(frame.images) == len(frame.masks) == 4
    assert all(image.shape == mask.shape == (480, 640) for image, mask in zip(frame.images, frame.masks, strict=True))
    with pytest.raises(InputError, match="frame 4; expected 0 to 3"):
        read_frame(session, 4)


def test_order():
    assert list(prefetch(range(20), lambda k: k * k)) == [k * k for k in range(20)]
    assert list(prefetch([], lambda k: k)) == []


def test_next_is_computed_while_the_consumer_works():
    computed = [threading.Event() for _ in range(3)]
    threads = set()

    def compute(k: int) -> int:
        threads.add(threading.get_ident())
        computed[k].set()
        return k

    for k in prefetch(range(3), compute):
        if k < 2:
            assert computed[k + 1].wait(timeout=10), "the next item waits for the consumer"
    assert threads.isdisjoint({threading.get_ident()})
    assert len(threads) == 1


def test_an_exception_comes_in_its_items_turn():
    def compute(k: int) -> int:
        if k == 2:
            raise InputError("frame 2 is broken")
        return k

    results = prefetch(range(5), compute)
    assert [next(results), next(results)] == [0, 1]
    with pytest.raises(InputError, match="frame 2 is broken"):
        next(results)


def test_an_exception_of_the_items_comes_in_its_turn():
    def items():
        yield 0
        raise InputError("no more")

    results = prefetch(items(), lambda k: k)
    assert next(results) == 0
    with pytest.raises(InputError, match="no more"):
        next(results)


def test_an_early_stop_leaves_no_thread():
    calls = []

    def compute(k: int) -> int:
        calls.append(k)
        time.sleep(0.01)
        return k

    results = prefetch(range(1000), compute)
    assert next(results) == 0
    results.close()
    assert len(calls) <= 2
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("prefetch")]
