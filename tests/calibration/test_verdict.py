"""Verdicts in words, from figures whose distribution is known."""

import numpy as np
import pytest
from scipy.stats import norm

from bayes_body.calibration.check import Findings
from bayes_body.calibration.coverage import coverage
from bayes_body.calibration.picture import draw_ranks
from bayes_body.calibration.verdict import verdict

BINS, COUNT = 20, 400
NAMES = ("hip", "knee", "still", "log-likelihood")


def findings(spread=1.0, shift=0.0, ess=500.0, moved=1.0, moved_shift=0.0, moves=True):
    """Truths of a normal posterior that is `spread` times too wide; the third quantity never varies."""
    rng = np.random.default_rng(0)
    truth = rng.normal(size=(COUNT, 4)) * [1, 1, 0, 1]
    draws = shift + spread * rng.normal(size=(BINS - 1, COUNT, 4))
    levels = norm.cdf((truth - shift) / spread)[:, :3]
    common = {"refused": np.zeros(COUNT, bool), "unbounded": np.zeros(COUNT, bool)}
    ranks = {"ranks": (draws < truth).sum(axis=0), "levels": levels, "truth": truth, "ess": np.full((COUNT, 3), ess), "lost": np.zeros(COUNT, bool)}
    after, other = rng.normal(size=(2, 2 * COUNT, 2))
    walked = {"after": after + moved_shift, "other": other, "moved": np.arange(2 * COUNT) < moved * 2 * COUNT}
    return Findings(NAMES, ranks | common, ("hip", "log-likelihood"), walked if moves else None)


def test_a_calibrated_kernel_passes():
    told = verdict(findings(), BINS)
    assert told.passed and told.sentences[-1] == "PASS."
    assert "all 3 quantities lie inside their bands (95% for all together), 400 replications" in told.sentences[0]
    quantities = told.figures["ranks"]["quantities"]
    assert set(quantities) == {"hip", "knee", "log-likelihood"}
    assert sum(quantities["hip"]["histogram"]) == COUNT
    assert quantities["hip"]["coverage"]["90%"]["low"] < 0.9 < quantities["hip"]["coverage"]["90%"]["high"]
    assert quantities["log-likelihood"]["coverage"] is None
    assert "it leaves the posterior invariant" in told.sentences[2]


@pytest.mark.parametrize(
    ("fault", "words"),
    [({"spread": 0.5}, "too narrow"), ({"spread": 2.0}, "too wide"), ({"shift": 0.8}, "lies too high"), ({"shift": -0.8}, "lies too low")],
)
def test_what_is_wrong_is_said(fault, words):
    told = verdict(findings(**fault), BINS)
    assert not told.passed and told.sentences[-1] == "FAIL."
    assert words in told.sentences[0]


def test_too_few_particles_leave_it_undecided():
    told = verdict(findings(ess=120.0), BINS)
    assert not told.passed and told.sentences[-1].startswith("UNDECIDED")
    assert (
        "120 effective (median), 120 (least), 200 wanted for 20 bins; 100.0% of the replications have too few: raise --particles" in told.sentences[1]
    )


def test_a_move_that_does_not_keep_the_posterior_fails():
    told = verdict(findings(moved_shift=0.5), BINS)
    assert not told.passed and "it does not leave the posterior invariant" in told.sentences[2]


def test_a_move_that_hardly_moves_says_little():
    told = verdict(findings(moved=0.05), BINS)
    assert "only 5.0% of the states moved, so this test is not informative" in told.sentences[2]


def test_a_kernel_without_a_move_is_said():
    told = verdict(findings(moves=False), BINS, "Markov move: none.")
    assert told.passed and told.sentences[2] == "Markov move: none."
    assert told.figures["moves"] is None


def test_coverage_has_its_binomial_interval():
    found = coverage(np.linspace(0.001, 0.999, 100), 0.5)
    assert found.share == 0.5
    assert np.allclose([found.low, found.high], [0.4038, 0.5962], atol=1e-3)


def test_ranks_are_drawn(tmp_path):
    path = tmp_path / "ranks.png"
    draw_ranks(findings(spread=0.5), BINS, path, "a kernel")
    assert path.stat().st_size > 10_000
