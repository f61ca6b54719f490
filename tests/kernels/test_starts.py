"""Where chains begin: what of the prediction they keep when the image says far more than it, and what they say of it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_forms.targets import conjugate

from bayes_body.density.density import Density
from bayes_body.density.factor import Factor, Particles, Variable
from bayes_body.kernels.hmc.starts import by_annealing, by_importance
from bayes_body.kernels.weights import resampler

DRAWS, CHAINS, BEFORE = 200, 16, 40
# Two poses that explain the image, to a fiftieth of what the prediction leaves open; the second one a little less well. They are so far apart that no
# prediction from beside the one comes near the other.
RIGHT, WRONG, SHARP, WORSE = np.array([3.0, 1.0, 0.5]), np.array([-3.0, -1.0, 0.2]), 0.02, 3.0


WAYS = [by_importance, pytest.param(by_annealing, marks=pytest.mark.slow)]


def _two_modes(values, data):
    x = values[Variable("x")]
    away = jnp.stack([jnp.sum((x - jnp.asarray(mode)) ** 2) for mode in (RIGHT, WRONG)])
    return jax.nn.logsumexp(-0.5 * away / SHARP**2 - jnp.array([0.0, WORSE]))


def _nothing(values, data):
    return -jnp.inf * jnp.ones(()) + 0 * values[Variable("x")][0]


def _started(begin, likelihood, seed=0):
    """The starts, if the even particles of the frame before are near one mode and the odd ones near the other."""
    transition = conjugate(1).density.transition
    modes = jnp.asarray(np.where(np.arange(BEFORE)[:, None] % 2, WRONG, RIGHT), jnp.float32)
    density = Density(transition, (Factor("y", "likelihood", (Variable("x"),), jax.tree_util.Partial(likelihood)),), {}, _equal(modes))
    resample = resampler("systematic")
    return jax.device_get(jax.jit(lambda key, density: begin(key, density.unconstrained(), DRAWS, CHAINS, resample))(jax.random.key(seed), density))


def _equal(states):
    return Particles({"x": states}, jnp.full(len(states), -jnp.log(len(states))))


def _nearer_to_right(positions):
    return np.linalg.norm(positions - RIGHT, axis=1) < np.linalg.norm(positions - WRONG, axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_annealing_keeps_both_modes_where_importance_keeps_a_draw_or_two(seed):
    few, many = (_started(begin, _two_modes, seed).starts.position["x"] for begin in (by_importance, by_annealing))
    assert few.shape == many.shape == (CHAINS, 3)
    assert len(np.unique(few, axis=0)) <= 3 and len(np.unique(many, axis=0)) >= 12
    assert 0 < _nearer_to_right(many).sum() < CHAINS
    # They lie where the image is explained, or a trajectory could not get there: over twelve seeds the median is 0.23, with a deviation of 0.04.
    nearest = np.minimum(*(np.linalg.norm(many - mode, axis=1) for mode in (RIGHT, WRONG)))
    assert np.median(nearest) < 0.23 + 4 * 0.04


@pytest.mark.parametrize("begin", WAYS)
def test_ancestors_and_evaluations_are_those_of_the_draws(begin):
    found = _started(begin, _two_modes)
    assert found.starts.ancestor.shape == (CHAINS,) and np.all((found.starts.ancestor >= 0) & (found.starts.ancestor < BEFORE))
    # The annealed filter crosses particles over, and a whole one may be another's.
    from_right = found.starts.ancestor % 2 == 0
    assert np.mean(from_right == _nearer_to_right(found.starts.position["x"])) >= (1 if begin is by_importance else 0.75)
    assert int(found.evaluations) == (DRAWS if begin is by_importance else 6 * DRAWS) and not found.lost and np.isfinite(found.log_evidence)


@pytest.mark.parametrize("begin", WAYS)
def test_an_image_that_nothing_explains_is_lost(begin):
    found = _started(begin, _nothing)
    assert found.lost and found.log_evidence == -np.inf and np.isfinite(found.starts.position["x"]).all()
