"""Progress without a terminal: few lines, each due, the first at once, and one after a silent minute."""

import re

import pytest

from bayes_body.base.progress import ProgressLog, steps_bar, waiting, watched
from bayes_body.runs.progress import progress_bar
from bayes_body.tracking.track import Progress

LINE = re.compile(r"\[\d\d:\d\d:\d\d\] (.*)")


class Clock:
    """Seconds that pass when a test says so."""

    now = 100.0

    def __call__(self):
        return self.now


@pytest.fixture
def said(capsys):
    """`said()`: the lines since the last call."""

    def call():
        captured = capsys.readouterr()
        assert captured.out == ""
        return [LINE.fullmatch(line).group(1) for line in captured.err.splitlines()]

    return call


def test_a_line_is_due_after_five_per_cent_and_ten_seconds(said):
    clock = Clock()
    log = ProgressLog("pictures", clock=clock)
    for done in range(1, 101):
        # A second a step, then four, then none to speak of.
        clock.now += 1.0 if done <= 20 else 4.0 if done <= 40 else 0.01
        log.move(done, 100)
    assert said() == [
        "pictures: 10 of 100 (10 %), about 2 min left",
        "pictures: 20 of 100 (20 %), about 80 s left",
        "pictures: 25 of 100 (25 %), about 2 min left",
        "pictures: 30 of 100 (30 %), about 2 min left",
        "pictures: 35 of 100 (35 %), about 2 min left",
        "pictures: 40 of 100 (40 %), about 2 min left",
        "pictures: 100 of 100 (100 %), 2 min in all",
    ]


def test_fast_work_says_nothing(said):
    clock = Clock()
    log = ProgressLog("figures", clock=clock)
    for done in range(1, 61):
        clock.now += 0.1
        log.move(done, 60)
        log.remind()
    assert said() == []


def test_after_a_silent_minute_it_says_where_it_is(said):
    clock = Clock()
    log = ProgressLog("tracking", "frame", clock)
    log.begin("compiling")
    for _ in range(13):
        clock.now += 10.0
        log.remind()
    log.move(1, 1000, "0.41 s/frame", 0.41)
    clock.now += 70.0
    log.remind()
    assert said() == [
        "tracking: compiling",
        "tracking: compiling, 60 s so far",
        "tracking: compiling, 2 min so far",
        "tracking: frame 1 of 1000 (0 %), 0.41 s/frame, 3 min so far",
    ]


def test_bars_are_lines_where_there_is_no_terminal(said):
    with progress_bar() as show:
        show(Progress(30, 60, 0.41, 212.0, 0.63, True))
        show(Progress(60, 60, 0.41, 212.0, 0.63, False))
    with waiting("first pose\x1b[31m"):
        pass
    with steps_bar(2, "arm × sir") as show:
        show(2, "arm × sir")
    assert list(watched("pictures")(range(5))) == list(range(5))
    assert [re.sub(r"\d+ s in all", "some s in all", line) for line in said()] == [
        "tracking: compiling",
        "tracking: frame 60 of 60 (100 %), 0.41 s/frame, ESS 212, survival 0.63, 1 lost, some s in all",
        "first pose\\x1b[31m ...",
        "steps: arm × sir",
        "steps: 2 of 2 (100 %), some s in all",
    ]


def test_nothing_where_none_is_asked_for(said):
    with progress_bar(False) as show, waiting("first pose", False):
        show(Progress(60, 60, 0.41, 212.0, 0.63, False))
    assert list(watched("pictures", False)(range(3))) == [0, 1, 2]
    assert said() == []
