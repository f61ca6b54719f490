"""The density of an edge's phase and amplitude: integrates to one, is the paper's, and is smooth where the phase wraps."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from bayes_body.model.likelihood.edge_phase import EdgeStatistics, clipped, log_density

STATISTICS = EdgeStatistics(np.array([0.3, 0.9]), np.array([3.0, 1.5]), np.array([0.2, 4.0]), np.array(-4.0))


@pytest.fixture(autouse=True)
def double_precision():
    with jax.enable_x64(True):
        yield


_log_density = jax.jit(lambda even, odd: log_density(even, odd, STATISTICS))
_clipped = jax.jit(clipped)


def _density(phase, rho):
    amplitude = np.exp(rho)
    return np.exp(_log_density(amplitude * np.cos(phase), amplitude * np.sin(phase)))


def test_phase_and_amplitude_have_a_density():
    phase = (np.arange(400) + 0.5) / 400 * math.pi
    rho = 0.2 + 3.8 * (np.arange(2000) + 0.5) / 2000
    values = _density(*np.meshgrid(phase, rho, indexing="ij"))
    assert abs(values.mean() * math.pi * 3.8 - 1) < 1e-3
    # Towards both ends it is clipped softly, and heavier than the Beta law.
    inside = (rho > 1.2) & (rho < 3.4)
    assert np.allclose(values.mean(axis=0)[inside] * math.pi, stats.beta(3.0, 1.5, 0.2, 3.8).pdf(rho[inside]), rtol=0.1)


def test_the_phase_is_that_of_the_paper():
    phase, share = np.linspace(0.1, math.pi - 0.1, 50), 0.7
    everywhere = (np.arange(400) + 0.5) / 400 * math.pi
    values, all_phases = np.split(_density(np.concatenate([phase, everywhere]), np.full(450, 0.2 + 3.8 * share)), [50])
    values = values / (all_phases.mean() * math.pi)
    epsilon = 0.3 + 0.6 * float(_clipped(share))
    printed = epsilon * stats.norm(math.pi / 2, 0.15 * math.pi).pdf(phase) + (1 - epsilon) / math.pi
    assert np.allclose(values, printed, atol=5e-3)


def test_it_is_smooth_where_the_phase_wraps():
    @jax.jit
    @jax.value_and_grad
    def at(phase):
        return log_density(3.0 * jnp.cos(phase), 3.0 * jnp.sin(phase), STATISTICS)

    for wrap in (0.0, math.pi, -math.pi):
        before, after = (at(wrap + step) for step in (-1e-7, 1e-7))
        assert np.isclose(before[0], after[0], atol=1e-6) and np.isclose(before[1], after[1], atol=1e-4)


def test_no_response_at_all_has_a_finite_density_and_gradient():
    value, slopes = jax.jit(jax.value_and_grad(lambda z: log_density(z[0], z[1], STATISTICS)))(np.zeros(2))
    assert math.isfinite(value) and np.isfinite(np.asarray(slopes)).all()


def test_amplitudes_have_no_slope_to_fall_down():
    """Where a hard clip broke off, (a - 1) / δ nats over the range of the amplitudes was the slope: 200 here."""
    rho = np.linspace(-4.0, 8.0, 4001)
    slopes = 3.8 * np.asarray(jax.jit(jax.vmap(jax.grad(lambda rho: log_density(jnp.zeros(()), jnp.exp(rho), STATISTICS))))(rho))
    assert np.abs(slopes).max() < 25
    assert np.abs(np.diff(slopes)).max() < 1.0


def test_a_share_stays_inside_its_clip():
    share = np.asarray(_clipped(np.linspace(-100.0, 101.0, 20_001)))
    assert (share >= 0.01).all() and (share <= 0.99).all() and (np.diff(share) > 0).all()
    assert np.isclose(_clipped(0.5), 0.5)
