"""Verdicts in words, from figures whose distribution is known."""

import arviz as az
import matplotlib.pyplot as plt
import numpy as np
import pytest
import xarray as xr
from scipy.stats import norm

from bayes_body.view.report.close_ups import arviz_plots
from bayes_body.workshop.calibration.check import INVARIANCE, SBC, Findings
from bayes_body.workshop.calibration.picture import draw_ranks, rank_tree, ranks_file, save_ranks
from bayes_body.workshop.calibration.verdict import coverage, verdict

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
    return Findings(NAMES, ranks | common, BINS, ("hip", "log-likelihood"), walked if moves else None)


def test_a_calibrated_kernel_passes():
    told = verdict(findings())
    assert told.passed and told.sentences[-1] == "PASS. A correct kernel fails in at most 1% of all checks."
    assert told.sentences[0].startswith("ranks: uniform, 400 replications; the smallest p of 3 is ")
    assert told.sentences[0].endswith("; a kernel fails at 0.00042 or less.")
    assert told.figures["false_alarm"] == 0.01 and not told.close
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
    told = verdict(findings(**fault))
    assert not told.passed and told.sentences[-1].startswith("FAIL.")
    assert words in told.sentences[0]


def test_too_few_particles_leave_it_undecided():
    told = verdict(findings(ess=120.0))
    assert not told.passed and told.sentences[-1].startswith("UNDECIDED")
    assert (
        "120 effective (median), 120 (least), 200 wanted for 20 bins; 100.0% of the replications have too few: raise --particles" in told.sentences[1]
    )


def test_a_move_that_does_not_keep_the_posterior_fails():
    told = verdict(findings(moved_shift=0.5))
    assert not told.passed and "it does not leave the posterior invariant" in told.sentences[2]


def test_a_move_that_hardly_moves_says_little():
    told = verdict(findings(moved=0.05))
    assert "only 5.0% of the states moved, so this test is not informative" in told.sentences[2]


def test_a_kernel_without_a_move_is_said():
    told = verdict(findings(moves=False))
    assert told.passed and "the kernel has none that leaves the posterior invariant" in told.sentences[2]
    assert told.figures["moves"] is None and np.isclose(told.figures["ranks"]["fails_at"], 0.01 * 0.25 / 3)


def test_coverage_has_its_binomial_interval():
    found = coverage(np.linspace(0.001, 0.999, 100), 0.5)
    assert found.share == 0.5
    assert np.allclose([found.low, found.high], [0.4038, 0.5962], atol=1e-3)


def test_too_few_particles_are_decided_by_the_first_look():
    found = findings()
    ess = np.where(np.arange(COUNT)[:, None] < COUNT // 4, 500.0, 120.0) * np.ones(3)
    late = found._replace(ranks=found.ranks | {"ess": ess}, looks={SBC: 2, INVARIANCE: 0})
    assert verdict(late).ess_suffices and "75.0% of the replications have too few" in verdict(late).sentences[1]
    assert not verdict(late._replace(looks={SBC: 0, INVARIANCE: 0})).ess_suffices


def test_a_close_test_is_named_and_no_other():
    found = findings()
    after = found.moves["after"] + [-0.15, 0.0]
    told = verdict(found._replace(moves=found.moves | {"after": after}))
    assert list(told.close) == [INVARIANCE]
    assert told.close[INVARIANCE].startswith("Markov move: close, ") and told.close[INVARIANCE].endswith(f": {2 * COUNT} more replications.")
    assert not verdict(found._replace(moves=found.moves | {"after": after}, looks={SBC: 0, INVARIANCE: 2})).close


def test_arviz_reads_the_ranks_and_finds_them_uniform(tmp_path):
    found, path = findings(), tmp_path / "check.ranks.nc"
    assert ranks_file(tmp_path / "check.json") == path
    save_ranks(found, path)
    with xr.open_datatree(path) as tree:
        rank = tree["prior_sbc"]["rank"].load()
    assert rank.dims == ("chain", "draw", "quantity") and rank.quantity.values.tolist() == ["hip", "knee", "log-likelihood"]
    assert (np.floor(rank.values[0] * BINS) == found.ranks["ranks"][:, [0, 1, 3]]).all()
    assert rank.min() >= 0 and rank.max() < 1
    # Its test is for continuous values: plain ranks have many equal ones.
    p, _, _ = rank.azstats.uniformity_test(dim=["chain", "draw"], method="pot_c")
    plain, _, _ = ((np.floor(rank * BINS) + 0.5) / BINS).azstats.uniformity_test(dim=["chain", "draw"], method="pot_c")
    assert (p > 0.01).all() and (plain < 0.05).all()
    with arviz_plots():
        drawn = az.plot_ecdf_pit(rank_tree(found), backend="matplotlib")
        assert drawn.viz["ecdf_lines"]["rank"].shape == (3,)
        plt.close(drawn.viz["figure"].item())


@pytest.mark.parametrize("kind", ["png", "svg"])
def test_ranks_are_drawn(tmp_path, kind):
    path = tmp_path / f"ranks.{kind}"
    found = findings(spread=0.5)
    draw_ranks(found._replace(names=("hip", "$\\frac{$", "still", "log-likelihood")), path, "a kernel with $ in its name")
    assert path.stat().st_size > 10_000
    assert not plt.get_fignums()
