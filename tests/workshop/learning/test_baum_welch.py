"""Baum and Welch's algorithm against two other programs, and what must not change its result."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from bayes_body.workshop.learning.baum_welch import FLOOR, Hmm, fit, log_likelihood, padded, step
from bayes_body.workshop.learning.hmm_choice import starts, stationary

STATES, ROUNDS = 5, 20
LENGTHS = (50, 70, 33)


@pytest.fixture(scope="module")
def sequences():
    """A noisy closed curve at a varying speed, with heavy tails: no hidden Markov model with Gaussian emissions."""
    rng = np.random.default_rng(0)

    def sequence(length):
        phase = rng.uniform(0, 6) + np.cumsum(rng.uniform(0.05, 0.3, length))
        curve = np.stack([np.cos(phase), np.sin(2 * phase), 0.4 * np.sin(phase + 1)], axis=1)
        return rng.uniform(0.8, 1.2) * curve + 0.1 * rng.standard_t(5, (length, 3))

    return [sequence(length) for length in LENGTHS]


@pytest.fixture(scope="module")
def begin(sequences):
    return starts(np.concatenate(sequences), STATES, (0, 1, 2))


@pytest.fixture(scope="module")
def found(sequences, begin):
    return fit(begin, padded(sequences), ROUNDS, -1.0)


def _of(models, k):
    return Hmm(*(part[k] for part in models))


def _same(one, other, within=1e-9):
    for here, there in zip(one, other, strict=True):
        np.testing.assert_allclose(here, there, atol=within, rtol=0)


@pytest.mark.parametrize("learn_initial", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_hmmlearn_finds_the_same(sequences, begin, learn_initial):
    hmm = pytest.importorskip("hmmlearn.hmm")
    # By default hmmlearn has priors; without their weight it maximises the likelihood.
    other = hmm.GaussianHMM(
        STATES,
        "full",
        min_covar=0,
        covars_prior=0,
        covars_weight=0,
        n_iter=ROUNDS,
        tol=-np.inf,
        init_params="",
        params="stmc" if learn_initial else "tmc",
    )
    other.startprob_, other.transmat_, other.means_, other.covars_ = _of(begin, 1)
    # Small products on many threads take longer than on one.
    with threadpool_limits(1):
        other.fit(np.concatenate(sequences), LENGTHS)
    found = fit(begin, padded(sequences), ROUNDS, -1.0, learn_initial)
    assert len(other.monitor_.history) == ROUNDS
    np.testing.assert_allclose(found.history[1], other.monitor_.history, atol=1e-8)
    np.testing.assert_allclose(found.log_likelihood[1], other.score(np.concatenate(sequences), LENGTHS), atol=1e-8)
    _same(_of(found.hmm, 1), (other.startprob_, other.transmat_, other.means_, other.covars_))


@pytest.mark.long
def test_dynamax_finds_the_same_counts(sequences, begin):
    """Its prior of the emissions cannot be switched off, so one step of the initial and transition probabilities is compared, and the likelihood."""
    dynamax = pytest.importorskip("dynamax.hidden_markov_model")
    one = _of(begin, 0)
    # All sequences of a batch have the same length there.
    shortest = min(LENGTHS)
    data = np.stack([sequence[:shortest] for sequence in sequences])
    with jax.enable_x64(True):
        other = dynamax.GaussianHMM(STATES, 3, initial_probs_concentration=1.0, transition_matrix_concentration=1.0)
        initial, transition, means, covariances = map(jnp.asarray, one)
        params, properties = other.initialize(
            initial_probs=initial, transition_matrix=transition, emission_means=means, emission_covariances=covariances
        )
        likelihoods = [float(other.marginal_log_prob(params, sequence)) for sequence in jnp.asarray(data)]
        after, _ = other.fit_em(params, properties, jnp.asarray(data), num_iters=1, verbose=False)
    here = padded(list(data))
    np.testing.assert_allclose(log_likelihood(one, here)[: len(data)], likelihoods, atol=1e-9)
    ours = step(one, here, learn_initial=True)
    np.testing.assert_allclose(ours.initial, after.initial.probs, atol=1e-9)
    np.testing.assert_allclose(ours.transition, after.transitions.transition_matrix, atol=1e-9)


def test_the_likelihood_never_falls(found):
    assert np.isfinite(found.history).all()
    before, after = found.history, np.column_stack([found.history[:, 1:], found.log_likelihood])
    assert (after > before - 1e-9).all()


def test_it_stops_when_little_is_gained(sequences, begin):
    enough = 0.02
    found = fit(begin, padded(sequences), ROUNDS, enough)
    for history in found.history:
        made = history[np.isfinite(history)]
        gains = np.diff(made) / sum(LENGTHS)
        assert 2 < len(made) < ROUNDS and np.isnan(history[len(made) :]).all()
        assert gains[-1] < enough and (gains[:-1] >= enough).all()


def test_starts_together_are_starts_alone(sequences, begin, found):
    for k in range(3):
        alone = fit(Hmm(*(part[k : k + 1] for part in begin)), padded(sequences), ROUNDS, -1.0)
        _same(_of(alone.hmm, 0), _of(found.hmm, k))
        assert alone.log_likelihood[0] == pytest.approx(found.log_likelihood[k], abs=1e-9)


def test_the_order_of_states_is_arbitrary(sequences, begin, found):
    order = np.array([3, 1, 4, 0, 2])
    turned = Hmm(begin.initial[:, order], begin.transition[:, order][:, :, order], begin.locations[:, order], begin.covariances[:, order])
    other = fit(turned, padded(sequences), ROUNDS, -1.0).hmm
    expected = found.hmm
    _same(
        other, (expected.initial[:, order], expected.transition[:, order][:, :, order], expected.locations[:, order], expected.covariances[:, order])
    )


def test_padding_changes_nothing(sequences, begin, found):
    data = padded([*sequences, np.zeros((0, 3))], 7)
    # What stands in frames that do not exist is never read.
    longer = np.concatenate([np.where(data.mask[..., None], data.values, np.nan), np.full((len(data.values), 40, 3), 1e9)], axis=1)
    mask = np.concatenate([data.mask, np.zeros((len(data.mask), 40), bool)], axis=1)
    other = fit(begin, data._replace(values=longer, mask=mask), ROUNDS, -1.0)
    _same(other.hmm, found.hmm)
    alone = [log_likelihood(_of(found.hmm, 0), padded([sequence]))[0] for sequence in sequences]
    together = log_likelihood(_of(found.hmm, 0), data)
    np.testing.assert_allclose(together[: len(alone)], alone, atol=1e-9)
    assert (together[len(alone) :] == 0).all()


def test_the_likelihood_is_the_sum_over_all_paths():
    rng = np.random.default_rng(2)
    transition = rng.uniform(size=(2, 2))
    hmm = Hmm(np.array([0.3, 0.7]), transition / transition.sum(axis=1, keepdims=True), np.array([[0.0], [1.0]]), np.array([[[0.5]], [[2.0]]]))
    values = np.array([[0.1], [1.2], [-0.4]])
    density = np.exp(-0.5 * (values - hmm.locations[:, 0]) ** 2 / hmm.covariances[:, 0, 0]) / np.sqrt(2 * np.pi * hmm.covariances[:, 0, 0])
    total = sum(
        hmm.initial[a] * density[0, a] * hmm.transition[a, b] * density[1, b] * hmm.transition[b, c] * density[2, c]
        for a in range(2)
        for b in range(2)
        for c in range(2)
    )
    assert log_likelihood(hmm, padded([values]))[0] == pytest.approx(np.log(total), abs=1e-12)


def test_a_state_of_one_frame_does_not_collapse():
    rng = np.random.default_rng(3)
    frames = rng.normal(size=(40, 2))
    frames[20] = 30.0
    found = fit(starts(frames, 3, (0,)), padded([frames]), ROUNDS, -1.0)
    smallest = np.linalg.eigvalsh(found.hmm.covariances).min()
    assert smallest == pytest.approx(FLOOR * frames.var(axis=0).mean(), rel=1e-6)
    assert np.isfinite(found.log_likelihood).all() and np.diff(found.history).min() > -1e-9


def test_a_state_without_frames_keeps_its_parameters(sequences, begin):
    one = _of(begin, 0)
    far = one._replace(locations=np.where(np.arange(STATES)[:, None] == 2, 1e3, one.locations))
    after = step(far, padded(sequences))
    assert all(np.isfinite(part).all() for part in after)
    np.testing.assert_array_equal(after.locations[2], far.locations[2])
    np.testing.assert_array_equal(after.transition[2], far.transition[2])


def test_double_precision_ends_with_the_fit(found):
    assert found.hmm.locations.dtype == np.float64 and not jax.config.jax_enable_x64


def test_the_stationary_distribution_does_not_change():
    rows = np.array([[0.0, 1.0, 0.0], [0.0, 0.5, 0.5], [1.0, 0.0, 0.0]])
    np.testing.assert_allclose(stationary(rows) @ rows, stationary(rows), atol=1e-9)
    # It alternates for ever, half of the time each.
    np.testing.assert_allclose(stationary(np.eye(2)[::-1]), 0.5, atol=1e-9)
