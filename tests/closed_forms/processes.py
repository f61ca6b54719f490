"""Linear Gaussian processes of first and of second order, and the exact distribution of all their frames given what is seen."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist

from bayes_body.density.density import Density
from bayes_body.density.factor import Factor, Particles, Transition, Variable
from bayes_body.density.frames import stacked

PARTICLES, BEFORE = 1000, "x_before"
ROOT, LOOK, LOOK_SD, FIRST_ROOT = np.array([[0.5, 0.0], [0.2, 0.3]]), np.array([[1.0, -0.5]]), 0.4, np.array([[1.0, 0.0], [-0.3, 0.7]])
# Fixed, and not drawn from the model: the smoother's equations hold for any data.
SEEN = np.array([[0.4], [0.9], [0.5], [-0.3], [0.2], [0.9]])
STEP_LOOK, STEP_SD, STEPS = np.array([[0.4, 1.0]]), 0.5, np.array([[0.1], [0.4], [-0.3], [-0.5], [0.2], [0.3]])


def _conditional(on, back, root, previous):
    return {"x": dist.MultivariateNormal(on @ previous["x"] + back @ previous.get(BEFORE, previous["x"]), scale_tril=root)}


def _noise(root, state, scale):
    return {"x": dist.MultivariateNormal(state["x"], scale_tril=scale * root)}


def _carry(previous, known):
    return {"x": known["x"], BEFORE: previous["x"]}


def _seen(look, sd, values, z):
    return jnp.sum(dist.Normal(look @ values[Variable("x")], sd).log_prob(z))


def _step_seen(look, sd, values, z):
    return jnp.sum(dist.Normal(look @ (values[Variable("x")] - values[Variable("x", -1)]), sd).log_prob(z))


class Process(NamedTuple):
    """x_t = on x_{t-1} + back x_{t-2} + N(0, Q), z = H x + N(0, R): correlated noise, and one observed mixture of two coordinates.

    If `linked`, a mixture of the step from the frame before is seen too.
    """

    on: np.ndarray
    back: np.ndarray
    memory: int
    linked: bool = False

    @property
    def transition(self):
        arguments = (jnp.asarray(self.on, float), jnp.asarray(self.back, float), jnp.asarray(ROOT))
        carried = {"carry": jax.tree_util.Partial(_carry), "memory": 2} if self.memory == 2 else {}
        return Transition("process", jax.tree_util.Partial(_conditional, *arguments), jax.tree_util.Partial(_noise, jnp.asarray(ROOT)), **carried)

    def density(self, frame, previous):
        look = jax.tree_util.Partial(_seen, jnp.asarray(LOOK), jnp.asarray(LOOK_SD))
        factors, data = [Factor("z", "likelihood", (Variable("x"),), look)], {"z": jnp.asarray(SEEN[frame])}
        if self.linked:
            step = jax.tree_util.Partial(_step_seen, jnp.asarray(STEP_LOOK), jnp.asarray(STEP_SD))
            factors.append(Factor("step", "likelihood", (Variable("x"), Variable("x", -1)), step))
            data["step"] = jnp.asarray(STEPS[frame])
        return Density(self.transition, tuple(factors), data, previous)

    def start(self, key, count=PARTICLES):
        x = jax.random.normal(key, (count, 2)) @ FIRST_ROOT.T
        return Particles({"x": x} | ({BEFORE: x} if self.memory == 2 else {}), jnp.full(count, -jnp.log(count)))

    def frames(self, count=len(SEEN)):
        return stacked([self.density(frame, self.start(jax.random.key(0))) for frame in range(count)])

    def exact(self, first_root=FIRST_ROOT):
        """Mean (6 x 2,) and covariance of all frames together, given all that is seen: one large normal distribution."""
        mean, covariance, _ = self._given(np.zeros(2), first_root)
        return mean, covariance

    def exact_after(self, particles):
        """Mean and second moments of all frames together after equally likely particles (particle, 2): a mixture of normal distributions."""
        found = [self._given(first, np.zeros((2, 2))) for first in particles]
        weights = np.exp([evidence for *_, evidence in found])
        moments = [(mean, covariance + np.outer(mean, mean)) for mean, covariance, _ in found]
        return tuple(np.average(each, axis=0, weights=weights) for each in zip(*moments, strict=True))

    def _given(self, first, first_root):
        """Mean, covariance and log-evidence after a first state N(first, root)."""
        frames, size = len(SEEN), 2 * (len(SEEN) + 1)
        # Rows: the states from before the first frame on, as mixtures of the first state and the noise.
        mixture, mean = np.zeros((size, size)), np.zeros(size)
        mixture[:2, :2], mean[:2] = first_root, first
        for t in range(1, frames + 1):
            here, before, earlier = (slice(2 * k, 2 * k + 2) for k in (t, t - 1, max(t - 2, 0)))
            mixture[here] = self.on @ mixture[before] + self.back @ mixture[earlier]
            mixture[here, here] += ROOT
            mean[here] = self.on @ mean[before] + self.back @ mean[earlier]
        prior, look = mixture @ mixture.T, np.kron(np.eye(frames, frames + 1, 1), LOOK)
        seen, noise = SEEN.ravel(), np.full(frames, LOOK_SD)
        if self.linked:
            look = np.concatenate([look, np.kron(np.eye(frames, frames + 1, 1) - np.eye(frames, frames + 1), STEP_LOOK)])
            seen, noise = np.concatenate([seen, STEPS.ravel()]), np.concatenate([noise, np.full(frames, STEP_SD)])
        spread, rest = look @ prior @ look.T + np.diag(noise**2), seen - look @ mean
        gain = prior @ look.T @ np.linalg.inv(spread)
        evidence = -0.5 * (rest @ np.linalg.solve(spread, rest) + np.linalg.slogdet(spread)[1])
        return (mean + gain @ rest)[2:], (prior - gain @ look @ prior)[2:, 2:], evidence


FIRST = Process(np.array([[1.0, 0.5], [-0.2, 0.9]]), np.zeros((2, 2)), 1)
SECOND = Process(np.array([[1.6, 0.2], [0.0, 1.2]]), np.array([[-0.7, 0.0], [0.1, -0.4]]), 2)
LINKED = FIRST._replace(linked=True)


def distance(exact, runs):
    """The largest distance of the runs' mean from what is exact, in standard errors over the runs."""
    errors = runs.std(axis=0, ddof=1) / np.sqrt(len(runs))
    # With few runs, the spread of one entry is known badly; entries of one kind have similar spreads.
    return (np.abs(runs.mean(axis=0) - exact) / np.maximum(errors, np.median(errors))).max()
