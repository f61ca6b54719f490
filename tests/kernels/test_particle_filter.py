"""What a constraint cuts off the prediction is divided out of the evidence."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest

from bayes_body.base.errors import InputError
from bayes_body.density.density import Density
from bayes_body.density.factor import Factor, Particles, Transition, Variable
from bayes_body.kernels import annealed, sir

X = Variable("x")


def _walk(previous):
    return {"x": dist.Normal(previous["x"], 1.0).to_event(1)}


def _noise(state, scale):
    return {"x": dist.Normal(state["x"], scale).to_event(1)}


def _tilted(values, data):
    return 0.8 * values[X][0] - 2.0


def _half(values, data):
    return jnp.where(values[X][0] > 0.5, -jnp.inf, 0.0)


def test_the_evidence_is_that_of_the_constrained_prediction():
    """E[exp(0.8 x - 2) | x < 0.5] for x ~ N(0, 1), in closed form."""
    count, keys = 20_000, 5
    particles = Particles({"x": jnp.zeros((count, 1))}, jnp.full(count, -np.log(count)))
    factors = (
        Factor("tilted", "likelihood", (X,), jax.tree_util.Partial(_tilted)),
        Factor("half", "constraint", (X,), jax.tree_util.Partial(_half)),
    )
    density = Density(Transition("walk", jax.tree_util.Partial(_walk), jax.tree_util.Partial(_noise)), factors, {}, particles)
    estimates = np.array([sir()(jax.random.key(k), particles, density)[1].log_evidence for k in range(keys)])
    cdf = jax.scipy.stats.norm.cdf
    exact = -2 + 0.8**2 / 2 + np.log(cdf(0.5 - 0.8)) - np.log(cdf(0.5))
    assert abs(estimates.mean() - exact) < 4 * estimates.std(ddof=1) / np.sqrt(keys)
    # Without the division it would be lower by log P(x < 0.5), a hundred standard errors away.
    assert -np.log(cdf(0.5)) > 20 * estimates.std(ddof=1)


@pytest.mark.parametrize(
    ("build", "arguments", "said"),
    [
        (annealed, {"layers": 0}, "annealed(): layers = 0; expected a number greater than or equal to 1"),
        (annealed, {"survival_rate": 1.0}, "annealed(): survival_rate = 1.0; expected a number less than 1"),
        (annealed, {"crossover_rate": -0.1}, "annealed(): crossover_rate = -0.1; expected a number greater than or equal to 0"),
    ],
)
def test_arguments_outside_their_range_are_said(build, arguments, said):
    with pytest.raises(InputError) as error:
        build(**arguments)
    assert said in str(error.value)
