"""Posteriors of one frame whose evidence and means are known: by conjugacy, or by quadrature."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist

from bayes_body.density.density import Density
from bayes_body.density.factor import Factor, Particles, Transition, Variable
from bayes_body.model.dynamics.diffusion import TruncatedWalk

X = Variable("x")


class Target(NamedTuple):
    """A frame: its density after given particles, how it starts, log p(z), and the posterior mean."""

    density: Density
    log_evidence: float
    mean: np.ndarray


def point_mass(state, count):
    """`count` equal particles, all of one state."""
    return Particles({"x": jnp.broadcast_to(jnp.asarray(state), (count, len(state)))}, jnp.full(count, -jnp.log(count)))


# -- a Gaussian prior of three correlated dimensions, two of whose mixtures are observed ------------------------------------------------------

ROOT = np.array([[1.0, 0.0, 0.0], [0.8, 0.5, 0.0], [-0.3, 0.2, 0.7]])
LOOK = np.array([[1.0, -0.5, 0.3], [0.2, 1.0, 1.0]])
NOISE = np.array([0.25, 0.4])
SEEN = np.array([1.9, -0.8])
CENTRE = np.array([0.3, -0.2, 0.1])


def _gaussian(root, previous):
    return {"x": dist.MultivariateNormal(previous["x"], scale_tril=root)}


def _shrunk(root, state, scale):
    return {"x": dist.MultivariateNormal(state["x"], scale_tril=scale * root)}


def _look(values, seen):
    return jnp.sum(dist.Normal(jnp.asarray(LOOK) @ values[X], jnp.asarray(NOISE)).log_prob(seen))


def conjugate(count):
    transition = Transition("gaussian", jax.tree_util.Partial(_gaussian, jnp.asarray(ROOT)), jax.tree_util.Partial(_shrunk, jnp.asarray(ROOT)))
    factor = Factor("seen", "likelihood", (X,), jax.tree_util.Partial(_look))
    prior = ROOT @ ROOT.T
    S = LOOK @ prior @ LOOK.T + np.diag(NOISE**2)
    surprise = SEEN - LOOK @ CENTRE
    log_evidence = -0.5 * (surprise @ np.linalg.solve(S, surprise) + np.linalg.slogdet(2 * np.pi * S)[1])
    mean = CENTRE + prior @ LOOK.T @ np.linalg.solve(S, surprise)
    return Target(Density(transition, (factor,), {"seen": jnp.asarray(SEEN)}, point_mass(CENTRE, count)), float(log_evidence), mean)


# -- a skewed one between two limits, off centre, with a wall ---------------------------------------------------------------------------------

LOW, HIGH, START, SD = np.array([0.0, -1.0]), np.array([2.0, 1.0]), np.array([0.4, 0.7]), np.array([0.5, 0.6])
WALL, GRID = 0.25, 1000


def _walk(previous):
    return {"x": TruncatedWalk(previous["x"], jnp.asarray(SD, jnp.float32), jnp.asarray(LOW, jnp.float32), jnp.asarray(HIGH, jnp.float32))}


def _noise(state, scale):
    return {"x": TruncatedWalk(state["x"], scale * jnp.asarray(SD, jnp.float32), jnp.asarray(LOW, jnp.float32), jnp.asarray(HIGH, jnp.float32))}


def _skewed(values, data):
    """A Gamma in the first coordinate, a Gumbel in the sum of both: they lean to one side."""
    x0, x1 = values[X][0], values[X][1]
    tilt = 5.0 * (x0 + x1 - 0.4)
    return 12.0 * jnp.log(x0 + 1e-6) - 10.0 * x0 + tilt - jnp.exp(tilt)


def wall(x1):
    """Steep, but no step: a tempered wall is another one."""
    return -0.5 * (jnp.maximum(x1 - WALL, 0.0) / 0.15) ** 2


def _wall(values, data):
    return wall(values[X][1])


@functools.cache
def _by_quadrature():
    """The log-evidence and the mean of the skewed posterior. Twice as many points change neither by a millionth."""
    x0, x1 = np.meshgrid(*(low + (high - low) * (np.arange(GRID) + 0.5) / GRID for low, high in zip(LOW, HIGH, strict=True)), indexing="ij")
    prior = np.exp(-0.5 * (((x0 - START[0]) / SD[0]) ** 2 + ((x1 - START[1]) / SD[1]) ** 2))
    allowed = prior * np.exp(-0.5 * (np.maximum(x1 - WALL, 0.0) / 0.15) ** 2)
    tilt = 5.0 * (x0 + x1 - 0.4)
    posterior = allowed * np.exp(12.0 * np.log(x0 + 1e-6) - 10.0 * x0 + tilt - np.exp(tilt))
    mean = np.array([(posterior * x0).sum(), (posterior * x1).sum()]) / posterior.sum()
    return float(np.log(posterior.sum() / allowed.sum())), mean


def skewed(count):
    """The evidence is that of the prediction that the wall leaves."""
    likelihood = Factor("y", "likelihood", (X,), jax.tree_util.Partial(_skewed))
    constraint = Factor("wall", "constraint", (X,), jax.tree_util.Partial(_wall))
    transition = Transition("walk", jax.tree_util.Partial(_walk), jax.tree_util.Partial(_noise))
    density = Density(transition, (likelihood, constraint), {}, point_mass(START.astype(np.float32), count))
    return Target(density, *_by_quadrature())
