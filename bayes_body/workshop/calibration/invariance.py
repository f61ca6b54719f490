r"""Test exact invariance (Geweke 2004; Gandy & Scott 2020): after a posterior-invariant move, a truth and its data have the same joint distribution.

$$s \sim p(s),\; z \sim p(z \mid s),\; s' \sim K_z(s, \cdot) \quad\Rightarrow\quad (s', z) \overset{d}{=} (s, z), \qquad \text{where}\quad
p(s' \mid z) = \int K_z(s, s')\, p(s \mid z)\, ds.$$

Each figure of (s', z) is compared with that of independent draws of (s, z) by the two-sample Kolmogorov-Smirnov test. There is no approximation: a
kernel's Markov move (kernels/markov_moves.py) is right or wrong, with any number of particles. The state has an ancestor, one of
`ANCESTORS` weighted particles of the previous frame. These are drawn for each case.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.stats import ks_2samp

from bayes_body.base.shapes import Index, Key
from bayes_body.density.density import Density
from bayes_body.density.factor import Particles, State
from bayes_body.kernels.markov_moves import MarkovMove
from bayes_body.workshop.calibration.problem import Problem, draw_case, draw_data, draw_path
from bayes_body.workshop.calibration.sbc import LOG_LIKELIHOOD

ANCESTORS = 16
TRANSITION, WEIGHT = "log-transition", "log-weight of the ancestor"


class Moved(NamedTuple):
    """Figures of a truth after its move, figures of another truth with its own data, and whether the move changed the state."""

    after: Float[Array, " figure"]
    other: Float[Array, " figure"]
    moved: Array
    refused: Array
    unbounded: Array


class _Joint(NamedTuple):
    """A state, its ancestor among the previous weighted particles, and the density given these particles and data simulated from the state."""

    state: State
    ancestor: Index
    density: Density
    refused: Array
    unbounded: Array


def figure_names(problem: Problem) -> tuple[str, ...]:
    """The names of the figures: quantities of the problem, log-likelihood, log-density of the transition, and log-weight of the ancestor."""
    return (*problem.quantities.names, LOG_LIKELIHOOD, TRANSITION, WEIGHT)


def replicate(problem: Problem, move: MarkovMove, applications: int = 1) -> Callable[..., Moved]:
    """Return one replication as a function of its key and of the problem, as in `sbc.replicate`. The move is applied `applications` times."""

    def replication(key: Key, problem: Problem = problem) -> Moved:
        true_key, other_key, move_key = jax.random.split(key, 3)
        true, independent = _joint(true_key, problem), _joint(other_key, problem)

        def apply_move(pair: tuple[State, Index], turn_key: Key) -> tuple[tuple[State, Index], None]:
            next_state, chosen = move(turn_key, *pair, true.density.previous, true.density)
            return jax.tree.map(lambda leaf, was: jnp.asarray(leaf, was.dtype), (dict(next_state), chosen), pair), None

        (next_state, chosen), _ = jax.lax.scan(apply_move, (true.state, true.ancestor), jax.random.split(move_key, applications))
        moved = jnp.any(jnp.stack([jnp.any(next_state[name] != value) for name, value in true.state.items()]))
        return Moved(
            after=_figures(problem, next_state, chosen, true.density),
            other=_figures(problem, independent.state, independent.ancestor, independent.density),
            moved=moved,
            refused=true.refused | independent.refused,
            unbounded=true.unbounded | independent.unbounded,
        )

    return replication


def p_values(moved: Float[np.ndarray, "replication figure"], independent: Float[np.ndarray, "replication figure"]) -> Float[np.ndarray, " figure"]:
    """Return for each figure the p-value of a test that moved and independent cases have the same distribution."""
    # The test's result is declared as a plain tuple.
    return np.array([cast(Any, ks_2samp(*pair)).pvalue for pair in zip(moved.T, independent.T, strict=True)])


def _joint(key: Key, problem: Problem) -> _Joint:
    first_key, weights_key, spread_key, path_key, data_key = jax.random.split(key, 5)
    first = draw_case(first_key, problem, 1).first
    spread = jax.vmap(lambda draw_key: problem.transition.sample(draw_key, first))(jax.random.split(spread_key, ANCESTORS))
    weights = jax.nn.log_softmax(jax.random.normal(weights_key, (ANCESTORS,), jax.tree.leaves(spread)[0].dtype))
    previous = Particles(dict(spread), weights)
    path = draw_path(path_key, problem, previous, 1)
    data = draw_data(data_key, problem, path)
    state, data = jax.tree.map(lambda leaf: leaf[0], (path.states, data))
    return _Joint(dict(state), path.start, problem.density(data, previous), path.refused, path.unbounded)


def _figures(problem: Problem, state: State, ancestor: Index, density: Density) -> Float[Array, " figure"]:
    previous_state = density.ancestor(ancestor)
    # The log-weight detects an ancestor that is chosen without its weight, which the state may not reveal.
    figures = jnp.stack(
        [density.log_likelihood(state, previous_state), density.transition.log_density(state, previous_state), density.previous.log_weights[ancestor]]
    )
    return jnp.concatenate([problem.quantities.compute(state), figures])
