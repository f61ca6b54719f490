"""Small generative models: a Gaussian with a filter in closed form, and a skewed one between limits; and what is wrong with a kernel on purpose."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist

from bayes_body.density.factor import Factor, Transition, Variable
from bayes_body.model.dynamics.diffusion import TruncatedWalk
from bayes_body.workshop.calibration.problem import Problem, Quantities

X = Variable("x")
partial = jax.tree_util.Partial


def _identity(state):
    return state["x"]


# -- a Gaussian -------------------------------------------------------------------------------------------------------------------------------

ROOT = np.array([[0.5, 0.0], [0.3, 0.4]], np.float32)
LOOK = np.array([[1.0, -0.5]], np.float32)
NOISE = np.float32(0.4)


def _step(previous):
    return {"x": dist.MultivariateNormal(previous["x"], scale_tril=jnp.asarray(ROOT))}


def _noise(state, scale):
    return {"x": dist.MultivariateNormal(state["x"], scale_tril=scale * jnp.asarray(ROOT))}


def _look(values, seen):
    return jnp.sum(dist.Normal(jnp.asarray(LOOK) @ values[X], NOISE).log_prob(seen))


def _seen(key, values):
    return jnp.asarray(LOOK) @ values[X] + NOISE * jax.random.normal(key, (1,))


def gaussian():
    factor = Factor("seen", "likelihood", (X,), partial(_look), simulate=partial(_seen))
    transition = Transition("gaussian", partial(_step), partial(_noise))
    return Problem(transition, (factor,), {"x": jnp.array([0.3, -0.2], jnp.float32)}, Quantities(("a", "b"), partial(_identity)))


# -- a skewed one between limits: a Gamma and a Gumbel ----------------------------------------------------------------------------------------

LOW, HIGH, SD = (np.array(side, np.float32) for side in ((0.0, -1.0), (2.0, 1.0), (0.5, 0.6)))
SHAPE = 3.0


def _walk(previous):
    return {"x": TruncatedWalk(previous["x"], jnp.asarray(SD), jnp.asarray(LOW), jnp.asarray(HIGH))}


def _shrunk(state, scale):
    return {"x": TruncatedWalk(state["x"], scale * jnp.asarray(SD), jnp.asarray(LOW), jnp.asarray(HIGH))}


def _rate(values):
    return SHAPE / (0.15 + values[X][0])


def _skewed(values, data):
    gamma = dist.Gamma(SHAPE, _rate(values)).log_prob(data[0])
    return gamma + dist.Gumbel(values[X][0] + values[X][1], 0.35).log_prob(data[1])


def _drawn(key, values):
    gamma_key, gumbel_key = jax.random.split(key)
    gamma = dist.Gamma(SHAPE, _rate(values)).sample(gamma_key)
    return jnp.stack([gamma, dist.Gumbel(values[X][0] + values[X][1], 0.35).sample(gumbel_key)])


def _wall(values, data):
    """Soft, and at most 0: what a path is accepted with."""
    return -0.5 * (jnp.maximum(values[X][1] - 0.25, 0.0) / 0.15) ** 2


def skewed(wall=False):
    factors = (Factor("y", "likelihood", (X,), partial(_skewed), simulate=partial(_drawn)),)
    if wall:
        factors += (Factor("wall", "constraint", (X,), partial(_wall)),)
    first = {"x": jnp.array([0.4, 0.5 if not wall else 0.0], jnp.float32)}
    return Problem(Transition("walk", partial(_walk), partial(_shrunk)), factors, first, Quantities(("a", "b"), partial(_identity)))


# -- mutants ----------------------------------------------------------------------------------------------------------------------------------


def _scaled(potential, power, values, data):
    return power * potential(values, data)


def powered(density, power):
    """The density with its likelihood to that power."""
    factors = tuple(
        dataclasses.replace(f, log_potential=partial(_scaled, f.log_potential, power)) if f.side == "likelihood" else f for f in density.factors
    )
    return dataclasses.replace(density, factors=factors)


def with_power(kernel, power):
    """A kernel whose weights are to that power: -1 is a wrong sign."""
    return lambda key, particles, density: kernel(key, particles, powered(density, power))


def forgetful(kernel):
    """A kernel that forgets its weights at the end."""

    def mutant(key, particles, density):
        after, info = kernel(key, particles, density)
        return after._replace(log_weights=jnp.full_like(after.log_weights, -jnp.log(after.log_weights.shape[0]))), info

    return mutant
