"""The page's section on message passing: there for a kernel that passes messages, with the parts and frames that moved most."""

import numpy as np
import pytest

from bayes_body.results.posterior.message_passing import DIMS
from bayes_body.view.report.figures import style
from bayes_body.view.report.message_passing import chosen_frames, message_section
from bayes_body.view.report.page import sections_of

RUNS, FRAMES, ITERATIONS, PARTS = 2, 6, 4, 5
SIZES = {"node": PARTS, "iteration": ITERATIONS, "tangent": 6, "proposal": 4}


@pytest.fixture
def passing(inspect):
    def call(**changed):
        rng = np.random.default_rng(0)
        arrays = {name: 0.1 + 0.1 * rng.random((RUNS, FRAMES, *(SIZES[dim] for dim in dims))) for name, dims in DIMS.items()}
        arrays |= {"samples": np.full((RUNS, FRAMES), 100)}
        # The fourth part of the third frame still moves.
        arrays["message_change"][:, :, -1] = 0.2
        arrays["message_change"][:, :, 0] = np.nan
        arrays["message_change"][:, 2, -1, 3] = 2.0
        return inspect(runs=RUNS, frames=FRAMES, **arrays | changed)

    return call


def test_a_kernel_without_messages_has_no_such_section(inspect):
    assert "messages" not in [name for name, _, _ in sections_of(inspect())]


@pytest.mark.slow
def test_convergence_is_shown_where_beliefs_still_move(passing):
    it = passing()
    assert "messages" in [name for name, _, _ in sections_of(it)]
    assert chosen_frames(it.diagnosis.messages) == [0, 2, 5]
    with style():
        text = message_section(it)
    assert "Change of the beliefs in each iteration of frame 2; in the last one most of 3," in text
    assert "Change in the last iteration over the frames, the worst part of each: median 0.2, from 0.2 to 2; the limit is 0.5." in text
    assert text.count("<img") == 5 + 3 and " nan" not in text


def test_a_single_iteration_has_no_convergence(passing):
    unknown = np.full((RUNS, FRAMES, 1, PARTS), np.nan)
    with style():
        text = message_section(passing(message_change=unknown, belief_sd=np.ones((RUNS, FRAMES, 1, PARTS, 6)), oscillation=unknown[:, :, 0]))
    assert "Convergence" not in text and text.count("<img") == 3
