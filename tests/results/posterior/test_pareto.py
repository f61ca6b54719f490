"""Pareto k: of weights whose tail is known, as ArviZ fits it, and where there is no tail to fit."""

import numpy as np
import pytest

from bayes_body.results.posterior.pareto import pareto_shape, tail_size

DRAWS = 4000


@pytest.mark.parametrize("k", [0.2, 0.5, 0.9, 1.3])
def test_the_shape_of_a_known_tail(k):
    rng = np.random.default_rng(3)
    # u^-k is a Pareto distribution of shape k.
    log_weights = -k * np.log(rng.uniform(size=(40, DRAWS)))
    found = pareto_shape(log_weights)
    # The prior pulls by 10 draws of a tail of 189 to 0.5; the spread of one fit is (1 + k) / sqrt(189).
    tail = tail_size(DRAWS)
    pulled = (tail * k + 10 * 0.5) / (tail + 10)
    assert abs(found.mean() - pulled) < 0.03 + 4 * (1 + k) / np.sqrt(tail * 40)
    assert found.std() < 2 * (1 + k) / np.sqrt(tail)


@pytest.mark.parametrize("draws", [40, 225, 226, 1000])
def test_as_arviz_fits_it(draws):
    from arviz_stats.base import array_stats

    rng = np.random.default_rng(draws)
    log_weights = 2.0 * rng.normal(size=(2, 5, draws))
    log_weights[0, 0, :3] = -np.inf
    found = pareto_shape(log_weights)
    for place in np.ndindex(2, 5):
        assert np.isclose(found[place], array_stats.psislw(-log_weights[place])[1], atol=1e-6)


def test_a_factor_of_all_weights_is_nothing():
    log_weights = np.random.default_rng(0).normal(size=(3, 500))
    assert np.allclose(pareto_shape(log_weights), pareto_shape(log_weights - 1e3))


def test_equal_weights_have_no_tail():
    assert (pareto_shape(np.full((2, 400), -np.log(400))) == -np.inf).all()


def test_a_few_draws_that_carry_everything():
    log_weights = np.full((1, 400), -np.inf)
    log_weights[0, 7] = 0.0
    assert pareto_shape(log_weights) == np.inf
    log_weights = np.full((1, 400), -2000.0)
    log_weights[0, :2] = 0.0, -0.1
    assert pareto_shape(log_weights) == np.inf


def test_too_few_draws_say_nothing():
    assert np.isnan(pareto_shape(np.random.default_rng(0).normal(size=(2, 24)))).all()
