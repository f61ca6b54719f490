"""A point and an axis of a part are roughly known: the density is normalised, and draws have it."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.base.geometry import rigid, rotations
from bayes_body.density.point_and_axis import PointAndAxis
from bayes_body.density.spaces import SE3
from bayes_body.density.tangent_normal import tangent_normal

COUNT = 40_000


def unit(*v):
    return jnp.asarray(np.array(v) / np.linalg.norm(v), jnp.float32)


def known(concentration, width=1.0):
    place, point, sd = (jnp.asarray(each, jnp.float32) for each in ([1.0, 2.0, 3.0], [0.1, -0.2, 0.3], width * np.array([0.02, 0.05, 0.1])))
    return PointAndAxis(place, point, sd, unit(1, 1, 0), unit(0, 1, 2), jnp.float32(concentration))


@jax.jit
def drawn_and_weighed(wide, exact):
    """Draws of the wide distribution, and the ratio of both densities."""
    x = jax.vmap(wide.sample)(jax.random.split(jax.random.key(1), COUNT))
    return x, jnp.exp(jax.vmap(exact.log_prob)(x) - jax.vmap(wide.log_prob)(x))


@pytest.mark.parametrize("concentration", [0.0, 2.0, 40.0])
def test_density_and_draws_agree(concentration):
    """Draws of a wider one, weighted by the ratio of densities, have mean weight 1 and the moments of the draws."""
    exact, wide = known(concentration), known(concentration / 2, 1.5)
    x, weights = (np.asarray(each, float) for each in drawn_and_weighed(wide, exact))
    own = np.asarray(drawn_and_weighed(exact, exact)[0], float)
    assert abs(weights.mean() - 1) < 4 * weights.std() / COUNT**0.5

    def figures(x):
        x = jnp.asarray(x, jnp.float32)
        return np.asarray(jnp.concatenate([rigid.apply(x, exact.point), rotations.to_matrix(x[:, 3:]).reshape(-1, 9)], axis=1), float)

    weighted, direct = weights[:, None] * figures(x), figures(own)
    error = np.hypot(weighted.std(0), direct.std(0)) / COUNT**0.5
    assert np.all(np.abs(weighted.mean(0) - direct.mean(0)) < 4 * error)
    # The mean cosine of a von Mises-Fisher distribution, and the place.
    cosine = np.asarray(rotations.rotate(own[:, 3:], np.asarray(exact.axis, float))) @ np.asarray(exact.direction, float)
    expected = 1 / math.tanh(concentration) - 1 / concentration if concentration else 0.0
    assert abs(cosine.mean() - expected) < 4 * cosine.std() / COUNT**0.5
    assert np.all(np.abs(direct[:, :3].std(0) / np.asarray(exact.sd_m) - 1) < 4 * (0.5 / COUNT) ** 0.5)


def test_a_prediction_whose_point_is_at_the_place():
    """Where rotations are nearly known, the product of both densities is the integral times the third one."""
    seen, mean = known(0.0), [0.93, 2.17, 2.72, *np.array([0.9, 0.1, -0.3, 0.3]) / np.linalg.norm([0.9, 0.1, -0.3, 0.3])]
    covariance = np.diag([0.05, 0.04, 0.06, 0.02, 0.03, 0.01]) ** 2
    predicted = tangent_normal(SE3(), jnp.asarray(mean, jnp.float32), jnp.asarray(covariance, jnp.float32))

    @jax.jit
    def ratios(seen, predicted):
        chosen, log_integral = seen.combine(predicted)
        x = jax.vmap(chosen.sample)(jax.random.split(jax.random.key(2), 500))
        log_density = jax.vmap(lambda x: seen.log_prob(x) + predicted.log_prob(x) - chosen.log_prob(x))(x)
        return log_density - log_integral + math.log(8 * math.pi**2)

    assert np.abs(np.asarray(ratios(seen, predicted))).max() < 0.1
