"""Looks: a correct kernel fails as seldom as is stated, a wrong one nearly always; and a close check draws more, whatever interrupts it."""

from functools import partial

import jax
import numpy as np
import pytest
from scipy.stats import binom, norm
from workshop.calibration import toys

from bayes_body.workshop.calibration import bands, looks, report
from bayes_body.workshop.calibration.check import SBC, Findings, Plan
from bayes_body.workshop.calibration.replications import Experiments, ReplicationLog, settings_of
from bayes_body.workshop.calibration.sbc import Replication
from bayes_body.workshop.calibration.sequential import decide
from bayes_body.workshop.calibration.verdict import Verdict

BINS, QUANTITIES, FIRST = 20, 11, 200
EVEN = np.full(BINS, 1 / BINS)


def failing(p_of_look, repetitions, tests):
    """Which of many repetitions of a test fail. `p_of_look(look, those)` are the p-values of some of them (repetition, quantity)."""
    failed, those = np.zeros(repetitions, bool), np.arange(repetitions)
    for look in range(len(looks.SHARES)):
        if not len(those):
            break
        p = p_of_look(look, those)
        limit = looks.limits(look, tests, p.shape[1])
        failed[those] = [looks.fails(one, limit) for one in p]
        those = those[[looks.is_close(one, limit) for one in p]]
    assert not len(those)
    return failed


def rank_tests(chances, repetitions, tests=1, seed=0):
    """Which checks of ranks fail; the ranks of each quantity fall into the bins with its chances (quantity, bin)."""
    rng, parts = np.random.default_rng(seed), np.diff((0, *looks.REPLICATIONS)) * FIRST
    counts = np.zeros((repetitions, QUANTITIES, BINS), int)

    def p_of_look(look, those):
        counts[those] += rng.multinomial(parts[look], chances, (len(those), QUANTITIES))
        return bands.p_values(counts[those].reshape(-1, BINS)).reshape(-1, QUANTITIES)

    return failing(p_of_look, repetitions, tests)


def wrong(spread, shift):
    """The chances of a truth's rank if the posterior has `spread` times the right standard deviation and a mean `shift` of them too high."""
    truth = norm.ppf((np.arange(4000) + 0.5) / 4000)
    return binom.pmf(np.arange(BINS)[:, None], BINS - 1, norm.cdf((truth - shift) / spread)).mean(axis=1)


@pytest.mark.slow
def test_a_correct_kernel_fails_as_seldom_as_stated():
    assert sum(looks.SHARES) == 1 and looks.FALSE_ALARM == 0.01
    repetitions = 10_000
    alone = rank_tests(EVEN, repetitions).mean()
    assert alone <= 0.01 + 3 * np.sqrt(0.01 * 0.99 / repetitions)
    # The limits are not so strict that nothing could fail.
    assert alone > 0.001


def test_quantities_that_depend_on_each_other_fail_as_seldom_as_stated():
    """Three times the same p-value, of a mean."""
    rng, repetitions = np.random.default_rng(1), 10_000
    sums = np.cumsum([rng.normal(scale=np.sqrt(part), size=repetitions) for part in np.diff((0, *looks.REPLICATIONS))], axis=0)

    def p_of_look(look, those):
        return np.repeat(2 * norm.sf(np.abs(sums[look][those]) / np.sqrt(looks.REPLICATIONS[look]))[:, None], 3, axis=1)

    assert failing(p_of_look, repetitions, 2).mean() <= 0.005 + 3 * np.sqrt(0.005 / repetitions)


@pytest.mark.parametrize(
    ("spread", "shift", "quantities"), [(0.6, 0.0, 1), (1.6, 0.0, 1), (1.0, 0.5, 1), (1.0, -0.5, 1), (0.8, 0.0, QUANTITIES), (1.0, 0.2, QUANTITIES)]
)
def test_a_slightly_wrong_kernel_fails_nearly_always(spread, shift, quantities):
    chances = np.tile(EVEN, (QUANTITIES, 1))
    chances[:quantities] = wrong(spread, shift)
    assert np.allclose(wrong(1.0, 0.0), EVEN, atol=1e-4)
    assert rank_tests(chances, 500, 2).mean() > 0.95


def test_limits_are_strict_at_first_and_meet_at_the_end():
    first, last = looks.limits(0, 2, 10), looks.limits(2, 2, 10)
    assert np.isclose(first.fails, 0.01 * 0.25 / 20) and np.isclose(first.passes, 0.01)
    assert np.isclose(last.fails, 0.01 * 0.5 / 20) and last.fails == last.passes
    p = np.array([0.5, first.passes / 2])
    assert looks.is_close(p, first) and not looks.fails(p, first)
    assert not looks.is_close(p, last)


# -- a whole check, of ranks that are drawn without a kernel ------------------------------------------------------------------------------------


def _drawn(key, problem, lean):
    """Ranks of three quantities; with the probability `lean` that of the first is redrawn from the lower half."""
    rank_key, lean_key, low_key, truth_key = jax.random.split(key, 4)
    ranks = jax.random.randint(rank_key, (3,), 0, BINS)
    low = jax.random.randint(low_key, (), 0, BINS // 2)
    ranks = ranks.at[0].set(jax.numpy.where(jax.random.uniform(lean_key) < lean, low, ranks[0]))
    truth = jax.random.normal(truth_key, (3,))
    false = jax.numpy.array(False)
    return Replication(ranks, (ranks[:2] + 0.5) / BINS, truth, jax.numpy.full(3, 500.0), false, false, false)


def _make(seed, lean):
    problem = toys.gaussian()
    return Experiments(seed, {SBC: partial(_drawn, lean=lean)}, problem)


def _decided(seed, lean, **given):
    lines = []
    found, told = decide(toys.gaussian(), partial(_make, seed, lean), False, 40, BINS, show=lines.append, **given)
    return found, told, lines


class _StoppedError(Exception):
    pass


# The first of the seeds from 0 whose first look is close.
CLOSE_SEED = 0


def test_a_close_check_draws_more_and_says_so(tmp_path):
    found, told, lines = _decided(CLOSE_SEED, 0.0)
    assert len(lines) == found.looks[SBC] > 0
    assert lines[0].startswith("ranks: close, the smallest p of 3 is ") and lines[0].endswith(": 40 more replications.")
    assert len(found.ranks["ranks"]) == 40 * looks.REPLICATIONS[found.looks[SBC]] == told.figures["ranks"]["replications"]
    assert not told.close and told.figures["ranks"]["look"] == found.looks[SBC] + 1

    def stop(blocks):
        yield from blocks[:2]
        if len(blocks) > 2:
            raise _StoppedError

    path = tmp_path / "kept"
    for _ in range(2):
        with pytest.raises(_StoppedError):
            _decided(CLOSE_SEED, 0.0, log=ReplicationLog(path, {}), watch=stop)
    assert len(ReplicationLog(path, {})) == 6
    again, told_again, lines_again = _decided(CLOSE_SEED, 0.0, log=ReplicationLog(path, {}))
    assert all((again.ranks[name] == found.ranks[name]).all() for name in found.ranks)
    assert told_again == told and lines_again == lines


def test_a_clear_check_ends_at_the_first_look():
    found, told, lines = _decided(1, 0.0)
    assert told.passed and not lines and len(found.ranks["ranks"]) == 40
    found, told, lines = _decided(1, 0.9)
    assert not told.passed and not lines and len(found.ranks["ranks"]) == 40
    assert "too high" in told.sentences[0] and told.sentences[-1] == "FAIL. A correct kernel fails in at most 1% of all checks."


def test_a_pilot_that_chose_too_few_particles_is_corrected_once_they_are_counted(tmp_path, monkeypatch):
    path, plan = tmp_path / "kept", Plan("arm_markers", "sir", {"particles": 500})
    tried, lines = [], []

    def checked(plan, replications, jobs, kept, watch, show):
        # The log was begun with this number of particles.
        tried.append((plan.options["particles"], settings_of(path)["options"]["particles"]))
        kept.add(SBC, 0, {"rank": np.zeros(1)})
        return Findings((), {}, BINS), Verdict(False, (), {"effective": {"short_share": 0.1}}, ess_suffices=plan.options["particles"] >= 2000)

    monkeypatch.setattr(report, "run_check", checked)
    used, _, told = report._checked(plan, True, 10, 0, path, lines.append, False)
    assert tried == [(500, 500), (1000, 1000), (2000, 2000)] and used.options["particles"] == 2000 and told.ess_suffices
    assert lines[0] == "particles: 500 are too few for 10.0% of the replications: once more with 1000."
    tried.clear()
    path.unlink()
    # The user's own number stays.
    used, _, told = report._checked(plan, False, 10, 0, path, lines.append, False)
    assert tried == [(500, 500)] and used == plan and not told.ess_suffices
