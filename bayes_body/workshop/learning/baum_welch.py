r"""Maximum likelihood of a hidden Markov model with Gaussian emissions, by the algorithm of Baum and Welch (Darby et al. 2008, 5).

The equations are those of Rabiner (1989, A tutorial on hidden Markov models, III and V). For a sequence $x_1 \dots x_T$, with
$b_j(x) = N(x; \mu_j, \Sigma_j)$:

$$\alpha_t(j) = b_j(x_t) \sum_i \alpha_{t-1}(i) A_{ij}, \qquad \beta_t(i) = \sum_j A_{ij}\, b_j(x_{t+1})\, \beta_{t+1}(j), \qquad
\gamma_t(i) = \alpha_t(i)\, \beta_t(i) / p(x),$$

$$A_{ij} \propto \sum_t \gamma_t(i)\, \frac{A_{ij}\, b_j(x_{t+1})\, \beta_{t+1}(j)}{\beta_t(i)},
\qquad \mu_j = \frac{\sum_t \gamma_t(j)\, x_t}{\sum_t \gamma_t(j)},$$

$$\Sigma_j = \frac{\sum_t \gamma_t(j)\, (x_t - \mu_j)(x_t - \mu_j)^T}{\sum_t \gamma_t(j)}.$$

All probabilities are logarithms, in double precision. Several sequences are padded to one length, and a mask says which frames exist. Several starts
are fitted together.

No eigenvalue of a covariance is below `FLOOR` times the mean variance of the data. Raising the smaller eigenvalues to this value maximises the
likelihood under that condition, so the likelihood never falls. If no eigenvalue is that small, the result is maximum likelihood.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from bayes_body.base.shapes import Flag, Index, Scalar

# Smallest eigenvalue of a covariance, as a fraction of the data's mean variance.
FLOOR = 1e-5
ROUNDS, ENOUGH = 50, 1e-4
# Frames and sequences are padded to multiples of these, so that data of similar size share a compiled program.
BLOCK, GROUP = 60, 4
# A state that is expected in fewer frames than this keeps its parameters: nothing can be learned about them.
EMPTY = 1e-10

type Numbers = Array | np.ndarray


class Hmm(NamedTuple):
    """A hidden Markov model: initial[i], transition[from, to], means and covariances of the emissions. Several starts are one axis in front."""

    initial: Float[Numbers, "*start state"]
    transition: Float[Numbers, "*start state state"]
    locations: Float[Numbers, "*start state feature"]
    covariances: Float[Numbers, "*start state feature feature"]


class Sequences(NamedTuple):
    """Sequences that are padded to one length, and which of their frames exist. A sequence may be empty."""

    values: Float[Numbers, "sequence frame feature"]
    mask: Bool[Numbers, "sequence frame"]


class Fitted(NamedTuple):
    """Result of `fit`.

    Attributes:
        hmm: the models, one for each start.
        log_likelihood: of all sequences together, nats.
        history: log-likelihood before each round; NaN after the last.
    """

    hmm: Hmm
    log_likelihood: Float[Numbers, " start"]
    history: Float[Numbers, "start round"]


class _Statistics(NamedTuple):
    """Expected counts and sums of one or all sequences, and their log-likelihood. Values are counted from the mean of the data."""

    initial: Float[Array, "*sequence state"]
    moves: Float[Array, "*sequence state state"]
    occupied: Float[Array, "*sequence state"]
    total: Float[Array, "*sequence state feature"]
    squares: Float[Array, "*sequence state feature feature"]
    log_likelihood: Float[Array, "*sequence"]


def padded(sequences: Sequence[Float[np.ndarray, "_ feature"]], count: int = 0) -> Sequences:
    """Return sequences of different lengths as one array, with empty sequences added: at least `count` in all."""
    longest, count = max(map(len, sequences)), max(count, len(sequences))
    values = np.zeros((count + -count % GROUP, longest + -longest % BLOCK, sequences[0].shape[1]))
    mask = np.zeros(values.shape[:2], bool)
    for row, sequence in enumerate(sequences):
        values[row, : len(sequence)] = sequence
        mask[row, : len(sequence)] = True
    return Sequences(values, mask)


def log_likelihood(hmm: Hmm, sequences: Sequences) -> Float[np.ndarray, " sequence"]:
    """Return the log-likelihood of each sequence under one model, nats; 0 for an empty sequence."""
    with jax.enable_x64(True):
        return np.asarray(_log_likelihoods(*_double(hmm, sequences)))


def fit(begin: Hmm, sequences: Sequences, rounds: int = ROUNDS, least_gain: float = ENOUGH, learn_initial: bool = False) -> Fitted:
    """Return the models that `rounds` steps of EM lead to, or fewer if a step gains less than `least_gain` nats per frame.

    Args:
        begin: one or more starts, as `starts` returns them.
        sequences: the data.
        rounds: most steps.
        least_gain: the gain at which a start has converged; below 0 all rounds are made.
        learn_initial: whether to estimate the initial probabilities too. Otherwise they stay those of the start.
    """
    mask = np.asarray(sequences.mask)
    data = np.asarray(sequences.values, float)[mask]
    floor = FLOOR * max(float(data.var(axis=0).mean()), 1e-12)
    with jax.enable_x64(True):
        fits = _fit(*_double(begin, sequences), data.mean(axis=0), floor, float(least_gain), rounds=rounds, learn_initial=learn_initial)
        return jax.tree.map(np.asarray, fits)


def step(hmm: Hmm, sequences: Sequences, learn_initial: bool = False) -> Hmm:
    """Return one model after one step of EM."""
    return Hmm(*(part[0] for part in fit(Hmm(*(part[None] for part in hmm)), sequences, 1, learn_initial=learn_initial).hmm))


def _double(hmm: Hmm, sequences: Sequences) -> tuple[Hmm, Sequences]:
    values = np.where(np.asarray(sequences.mask)[..., None], sequences.values, 0.0)
    return Hmm(*(np.asarray(part, float) for part in hmm)), Sequences(values, np.asarray(sequences.mask))


@partial(jax.jit, static_argnames=("rounds", "learn_initial"))
def _fit(
    begin: Hmm, data: Sequences, middle: Float[Array, " feature"], floor: Scalar, least_gain: Scalar, rounds: int, learn_initial: bool
) -> Fitted:
    frames = data.mask.sum()

    def unfinished(state: tuple[Hmm, Array, Index, Flag]) -> Flag:
        return (state[2] < rounds) & ~state[3]

    def once(state: tuple[Hmm, Array, Index, Flag]) -> tuple[Hmm, Array, Index, Flag]:
        hmm, history, number, _ = state
        statistics = _expected(hmm, data, middle)
        gain = statistics.log_likelihood - jnp.where(number > 0, history[number - 1], -jnp.inf)
        history = history.at[number].set(statistics.log_likelihood)
        return _maximised(hmm, statistics, middle, floor, learn_initial), history, number + 1, gain < least_gain * frames

    def climb(start: Hmm) -> Fitted:
        begun = (start, jnp.full(rounds, jnp.nan), jnp.asarray(0), jnp.asarray(False))
        hmm, history, _, _ = jax.lax.while_loop(unfinished, once, begun)
        return Fitted(hmm, _log_likelihoods(hmm, data).sum(), history)

    return jax.vmap(climb)(begin)


@jax.jit
def _log_likelihoods(hmm: Hmm, data: Sequences) -> Float[Array, " sequence"]:
    return jax.vmap(lambda values, mask: _forward(hmm, values, mask)[1])(*data)


def _forward(hmm: Hmm, values: Float[Array, "frame feature"], mask: Bool[Array, " frame"]) -> tuple[Array, Scalar, Array]:
    """Return log alpha in each frame, the log-likelihood, and the log-densities of the emissions (0 in a frame that does not exist)."""
    emitted = jnp.where(mask[:, None], _log_emissions(hmm, values), 0.0)
    moves = jnp.log(hmm.transition)

    def forward(alpha: Array, frame: tuple[Array, Flag]) -> tuple[Array, Array]:
        density, exists = frame
        alpha = jnp.where(exists, jax.nn.logsumexp(alpha[:, None] + moves, axis=0) + density, alpha)
        return alpha, alpha

    first = jnp.log(hmm.initial) + emitted[0]
    last, log_alphas = jax.lax.scan(forward, first, (emitted[1:], mask[1:]))
    return jnp.concatenate([first[None], log_alphas]), jax.nn.logsumexp(last), emitted


def _log_emissions(hmm: Hmm, values: Float[Array, "frame feature"]) -> Float[Array, "frame state"]:
    root = jnp.linalg.cholesky(hmm.covariances)
    features = values.shape[1]
    inverse = jax.vmap(lambda factor: jax.scipy.linalg.solve_triangular(factor, jnp.eye(features), lower=True))(root)
    white = jnp.einsum("nij,tnj->tni", inverse, values[:, None] - hmm.locations)
    size = jnp.log(jnp.diagonal(root, axis1=1, axis2=2)).sum(axis=1) + 0.5 * features * jnp.log(2 * jnp.pi)
    return -0.5 * jnp.sum(white**2, axis=2) - size


def _expected(hmm: Hmm, data: Sequences, middle: Float[Array, " feature"]) -> _Statistics:
    """Return the expected statistics, summed over the sequences."""
    statistics = jax.vmap(lambda values, mask: _of_sequence(hmm, values, mask, middle))(*data)
    return jax.tree.map(lambda part: part.sum(axis=0), statistics)


def _of_sequence(hmm: Hmm, values: Float[Array, "frame feature"], mask: Bool[Array, " frame"], middle: Float[Array, " feature"]) -> _Statistics:
    alpha, total, emitted = _forward(hmm, values, mask)
    moves = jnp.log(hmm.transition)

    def back(state: tuple[Array, Array], frame: tuple[Array, Array, Flag]) -> tuple[tuple[Array, Array], Array]:
        beta, counted = state
        forward, density, exists = frame
        ways = moves + density + beta
        next_beta = jax.nn.logsumexp(ways, axis=1)
        # The probability of a state, times that of its next state given all that follows.
        pairs = jnp.exp(forward + next_beta - total)[:, None] * jnp.exp(ways - next_beta[:, None])
        return (jnp.where(exists, next_beta, beta), counted + jnp.where(exists, pairs, 0.0)), jnp.where(exists, next_beta, beta)

    ended = jnp.zeros_like(alpha[0])
    (_, counted), earlier = jax.lax.scan(back, (ended, jnp.zeros_like(moves)), (alpha[:-1], emitted[1:], mask[1:]), reverse=True)
    gamma = jnp.exp(alpha + jnp.concatenate([earlier, ended[None]]) - total) * mask[:, None]
    deviations = values - middle
    squares = jnp.einsum("tn,ti,tj->nij", gamma, deviations, deviations)
    return _Statistics(gamma[0], counted, gamma.sum(axis=0), gamma.T @ deviations, squares, total)


def _maximised(hmm: Hmm, statistics: _Statistics, middle: Float[Array, " feature"], floor: Scalar, learn_initial: bool) -> Hmm:
    used, has_moves = statistics.occupied > EMPTY, statistics.moves.sum(axis=1) > EMPTY
    count = jnp.where(used, statistics.occupied, 1.0)
    deviations = statistics.total / count[:, None]
    covariances = _floored(statistics.squares / count[:, None, None] - deviations[:, :, None] * deviations[:, None, :], floor)
    rows = statistics.moves / jnp.where(has_moves, statistics.moves.sum(axis=1), 1.0)[:, None]
    return Hmm(
        statistics.initial / statistics.initial.sum() if learn_initial else hmm.initial,
        jnp.where(has_moves[:, None], rows, hmm.transition),
        jnp.where(used[:, None], middle + deviations, hmm.locations),
        jnp.where(used[:, None, None], covariances, hmm.covariances),
    )


def _floored(covariances: Float[Array, "state feature feature"], floor: Scalar) -> Float[Array, "state feature feature"]:
    sizes, axes = jnp.linalg.eigh(covariances)
    raised = jnp.einsum("nik,nk,njk->nij", axes, jnp.maximum(sizes, floor), axes)
    return jnp.where((sizes[:, :1] < floor)[..., None], raised, covariances)
