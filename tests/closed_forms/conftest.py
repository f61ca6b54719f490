"""Models with answers in closed form, and the example programs as modules."""

import importlib.util
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest

from bayes_body.density.density import Density
from bayes_body.density.factor import Factor, Particles, Transition, Variable

POSITION = Variable("x")


def _step(A, Q_root, previous):
    return {"x": dist.MultivariateNormal(A @ previous["x"], scale_tril=Q_root)}


def _noise(Q_root, state, scale):
    return {"x": dist.MultivariateNormal(state["x"], scale_tril=scale * Q_root)}


def _observed(H, R_sd, values, y):
    return jnp.sum(dist.Normal(H @ values[POSITION], R_sd).log_prob(y))


class LinearGaussian(NamedTuple):
    """x' = A x + N(0, Q), y = H x + N(0, R): correlated noise, an unstable direction, one observed mixture of the two coordinates."""

    A: np.ndarray
    Q_root: np.ndarray
    H: np.ndarray
    R_sd: float
    m0: np.ndarray
    P0_root: np.ndarray

    def density(self, y, previous):
        transition = Transition(
            "linear",
            jax.tree_util.Partial(_step, jnp.asarray(self.A), jnp.asarray(self.Q_root)),
            jax.tree_util.Partial(_noise, jnp.asarray(self.Q_root)),
        )
        factor = Factor("y", "likelihood", (POSITION,), jax.tree_util.Partial(_observed, jnp.asarray(self.H), jnp.asarray(self.R_sd)))
        return Density(transition, (factor,), {"y": jnp.asarray(y)}, previous)

    def start(self, key, count):
        states = self.m0 + jax.random.normal(key, (count, 2)) @ self.P0_root.T
        return Particles({"x": states}, jnp.full(count, -jnp.log(count)))

    def kalman(self, ys):
        """Filtered means, covariances and the log-evidence of each observation."""
        m, P = self.m0, self.P0_root @ self.P0_root.T
        Q, out = self.Q_root @ self.Q_root.T, []
        for y in ys:
            m, P = self.A @ m, self.A @ P @ self.A.T + Q
            S = self.H @ P @ self.H.T + self.R_sd**2 * np.eye(len(y))
            r = y - self.H @ m
            K = P @ self.H.T @ np.linalg.inv(S)
            evidence = -0.5 * (r @ np.linalg.inv(S) @ r + np.linalg.slogdet(2 * np.pi * S)[1])
            m, P = m + K @ r, P - K @ S @ K.T
            out.append((m, P, evidence))
        return [np.array(column) for column in zip(*out, strict=True)]


@pytest.fixture
def linear_gaussian():
    return LinearGaussian(
        A=np.array([[1.0, 0.5], [-0.2, 0.9]]),
        Q_root=np.array([[0.5, 0.0], [0.2, 0.3]]),
        H=np.array([[1.0, -0.5]]),
        R_sd=0.4,
        m0=np.array([0.5, -1.0]),
        P0_root=np.array([[1.0, 0.0], [-0.3, 0.7]]),
    )


@pytest.fixture
def observations():
    """Fixed, and not drawn from the model: the filter's equations hold for any data."""
    return np.array([[0.4], [1.7], [0.2], [-0.9], [1.1], [2.5], [2.2], [0.3]])


@pytest.fixture(scope="module")
def program(request):
    """The program of the folder `inference` that the test module names as PROGRAM."""
    path = Path(__file__).parents[2] / "inference" / request.module.PROGRAM
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
