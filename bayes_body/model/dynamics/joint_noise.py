r"""Process noise within the joint limits (Poon & Fleet 2002, 3.3): Beta for a limited dof, normal for a translation, wrapped normal for a full turn.

Let $u$ be the position within $[\mathrm{low}, \mathrm{high}]$ as a fraction of the range. The variance $v$ of $u$ is fixed, and its mode is the
prediction clipped to the limits ("the densities become increasingly skewed as the prediction approaches the boundaries"):

$$u \sim \mathrm{Beta}(1 + m\kappa,\ 1 + (1 - m)\kappa), \qquad
v = \frac{(1 + m\kappa)(1 + (1 - m)\kappa)}{(2 + \kappa)^2 (3 + \kappa)}, \qquad m = \mathrm{clip}(u^p, 0, 1),$$

$v$ decreases strictly in $\kappa \ge 0$ from $1/12$, the variance of the uniform distribution: no larger variance has a mode inside.

All parameters of these Beta distributions are at least 1. Their normaliser and draws take a few operations each. Draws are made by rejection from a
log-logistic distribution (Cheng 1978, algorithm BB). With $\lambda^2 = (2ab - a - b) / (a + b - 2)$ and uniform $U$, the odds are proposed as

$$\frac{x}{1 - x} = \frac{a}{b}\, e^{V}, \qquad V = \frac{1}{\lambda} \log\frac{U}{1 - U},$$

and accepted with the ratio of the densities, divided by its largest value, which it takes at $V = 0$:

$$\log r = (a + \lambda) V - 2 \log 2U - (a + b) \log\!\Big(1 + \frac{a}{a + b} (e^V - 1)\Big).$$

The distribution is exact. At most 1.48 trials are needed on average, whatever the parameters. JAX's own draw divides two gamma variables, each from
two nested loops with a random key for every entry. It takes several times as long, and its program is many times as large.

The logarithm of the normaliser is Stirling's formula for $B(a + 2, b + 2)$ with the remainder as Stieltjes' continued fraction,

$$\log\Gamma(x) = (x - \tfrac12) \log x - x + \tfrac12 \log 2\pi + \cfrac{c_0}{x + \cfrac{c_1}{x + \cdots}},$$

and $B(a, b)$ follows by a rational factor. Its error is below 4e-9. In single precision it is smaller than that of sums of log-gamma functions, whose
digits cancel, and the derivative needs no digamma function.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float
from numpyro.distributions import constraints

from bayes_body.base.shapes import Index, Key, Pose, Scalar
from bayes_body.density.sharding import varying_like
from bayes_body.model.dynamics.limits import InBox

# Of Stieltjes' continued fraction.
COEFFICIENTS = (1 / 12, 1 / 30, 53 / 210, 195 / 371, 22999 / 22737)

type _Drawn = tuple[Index, Float[Array, "*shape"], Bool[Array, "*shape"]]


def log_beta(a: Float[Array, "*parameter"], b: Float[Array, "*parameter"]) -> Float[Array, "*parameter"]:
    """Return log B(a, b) for a, b ≥ 1."""
    n = a + b
    # B(a, b) / B(a + 2, b + 2)
    factor = (n / a) * ((n + 1) / (a + 1)) * ((n + 2) / b) * ((n + 3) / (b + 1))
    a, b, n = a + 2, b + 2, n + 4
    stirling = 0.5 * math.log(2 * math.pi) - a * jnp.log1p(b / a) - b * jnp.log1p(a / b) + jnp.log(factor * jnp.sqrt(n / a / b))
    return stirling + _remainder(a) + _remainder(b) - _remainder(n)


def _remainder(x: Float[Array, "*parameter"]) -> Float[Array, "*parameter"]:
    below = x
    for coefficient in COEFFICIENTS[:0:-1]:
        below = x + coefficient / below
    return COEFFICIENTS[0] / below


def beta_draws(key: Key, a: Float[Array, "*parameter"], b: Float[Array, "*parameter"], shape: tuple[int, ...]) -> Float[Array, "*shape"]:
    """Draw from Beta(a, b) with a, b ≥ 1.

    Where a parameter is not a number, so is the draw.

    Args:
        key: random key.
        a: first parameters.
        b: second parameters.
        shape: of the draws, to which the parameters are broadcast.
    """
    # λ² without cancellation near 1.
    p, q = a - 1, b - 1
    shrink = jax.lax.rsqrt(1 + 2 * p * q / jnp.maximum(p + q, jnp.finfo(a.dtype).tiny))
    # Half a step of the uniform numbers keeps them between 0 and 1.
    half = jnp.finfo(a.dtype).epsneg

    def trial(drawn: _Drawn) -> _Drawn:
        number, value, accepted = drawn
        u, level = half + jax.random.uniform(jax.random.fold_in(key, number), (2, *shape), a.dtype)
        v = shrink * (jnp.log(u) - jnp.log1p(-u))
        log_ratio = (a + 1 / shrink) * v - 2 * jnp.log(2 * u) - (a + b) * jnp.log1p(a / (a + b) * jnp.expm1(v))
        odds = a * jnp.exp(v)
        # Written so that what is not a number ends the loop.
        return number + 1, jnp.where(accepted, value, odds / (odds + b)), accepted | ~(log_ratio < jnp.log(level))

    start = varying_like((jnp.zeros(shape, a.dtype), jnp.zeros(shape, bool)), (key, a, b))
    return jax.lax.while_loop(lambda drawn: ~jnp.all(drawn[2]), trial, (jnp.zeros((), jnp.int32), *start))[1]


# The largest variance of u, just below that of the uniform distribution.
LARGEST_VARIANCE = (1 - 1e-4) / 12
# Nearer to a limit than this fraction of the range, the log-density is constant; otherwise it would go to minus infinity.
NEAREST = 1.2e-7
# These many iterations reach float64's rounding for every mode and every variance from 1e-9 to the largest.
NEWTON_STEPS = 6


class JointNoise(InBox):
    """Independent dofs, each with its kind of noise; scalar log_prob.

    A freely turning dof keeps its own coordinate, which counts turns: its density has the period 2π and integrates to one over a turn. A sigmoid to
    (−π, π), as in numpyro's von Mises distribution, would make the half turn a barrier.
    """

    arg_constraints = {"centre": constraints.real_vector, "scale": constraints.real_vector}
    reparametrized_params: list[str] = []
    pytree_data_fields = ("centre", "scale", "low", "high", "angular", "alpha", "beta", "log_norm")

    def __init__(self, centre: Pose, scale: Pose, low: Pose, high: Pose, angular: Bool[Array, " dof"], *, validate_args: bool | None = None):
        """Compute what depends only on the centre, once for all values that are evaluated.

        Args:
            centre: the mode before clipping to the limits; radians or metres.
            scale: standard deviations, radians or metres; for a limited dof less than the range / √12.
            low: limits, or −∞.
            high: limits, or ∞.
            angular: which dofs are angles.
            validate_args: as in numpyro.
        """
        self.centre, self.scale, self.low, self.high, self.angular = centre, scale, low, high, angular
        safe_low, width = self._safe
        share = jnp.clip((centre - safe_low) / width, 0.0, 1.0)
        kappa = concentration(share, jnp.minimum((scale / width) ** 2, LARGEST_VARIANCE))
        self.alpha, self.beta = 1 + share * kappa, 1 + (1 - share) * kappa
        self.log_norm = jnp.where(self._limited, log_beta(self.alpha, self.beta) + jnp.log(width), jnp.log(scale) + 0.5 * math.log(2 * math.pi))
        super().__init__(batch_shape=(), event_shape=centre.shape, validate_args=validate_args)

    @property
    def _limited(self) -> Bool[Array, " dof"]:
        return jnp.isfinite(self.low) & jnp.isfinite(self.high)

    @property
    def _safe(self) -> tuple[Pose, Pose]:
        # Reverse mode differentiates both branches of a where, so the unused one must be finite too.
        low = jnp.where(self._limited, self.low, 0.0)
        return low, jnp.where(self._limited, self.high, 1.0) - low

    def sample(self, key: Key, sample_shape: tuple[int, ...] = ()) -> Float[Array, "*sample dof"]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Beta draws inside the limits, normal draws elsewhere. For a full turn, the coordinate is the one nearest to the mode."""
        beta_key, normal_key = jax.random.split(key)
        shape = (*sample_shape, *self.event_shape)
        low, width = self._safe
        limited = low + width * beta_draws(beta_key, self.alpha, self.beta, shape)
        free = self.centre + self.scale * jax.random.normal(normal_key, shape, self.centre.dtype)
        return jnp.where(self._limited, jnp.clip(limited, self.low, self.high), free)

    def log_prob(self, value: Pose, intermediates: Any = None) -> Scalar:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The log-density; minus infinity outside the limits."""
        del intermediates
        return _log_probs(value, self, self)

    def log_prob_each(self, value: Pose) -> Float[Array, " component"]:
        """The log-densities of one value under a batch of distributions with equal scale and limits; the leading axis is the component.

        Everything that does not depend on the component, above all the logarithms of u and 1 - u, is computed once.
        """
        return _log_probs(value, self, jax.tree.map(lambda leaf: leaf[0], self))


def _log_probs(value: Pose, batch: JointNoise, component: JointNoise) -> Float[Array, " *component"]:
    """The log-density of one distribution, or of a batch; `component` has the limits and scale that all share."""
    low, width = component._safe
    limited, inside = component._limited, (value >= component.low) & (value <= component.high)
    share = jnp.clip((value - low) / width, NEAREST, 1 - NEAREST)
    beta = (batch.alpha - 1) @ jnp.where(limited, jnp.log(share), 0.0) + (batch.beta - 1) @ jnp.where(limited, jnp.log1p(-share), 0.0)
    z = jnp.where(limited, 0.0, value - batch.centre)
    free = jnp.where(component.angular & ~limited, _log_wrapped(z, component.scale), -0.5 * (z / component.scale) ** 2)
    return jnp.where(jnp.all(inside), beta + jnp.sum(free - batch.log_norm, axis=-1), -jnp.inf)


def _log_wrapped(z: Float[Array, "*component dof"], scale: Pose) -> Float[Array, "*component dof"]:
    """The normal density wrapped around the circle, without its constant: the nearest turn and its two neighbours."""
    turn = 2 * math.pi
    nearest = z - turn * jnp.round(z / turn)
    # The neighbours relative to the nearest: -((z ± 2π)² - z²) / 2.
    neighbours = jnp.exp((-turn * (turn / 2 + nearest)) / scale**2) + jnp.exp((-turn * (turn / 2 - nearest)) / scale**2)
    # A plain logarithm takes a third of log1p's time, and its rounding error is negligible beside the first term.
    return -0.5 * (nearest / scale) ** 2 + jnp.log(1 + neighbours)


# Several places of a program build these distributions; jit avoids tracing this again.
@jax.jit
def concentration(mode: Float[Array, " *dof"], variance: Float[Array, " *dof"]) -> Float[Array, " *dof"]:
    """κ of the Beta distribution with this mode in [0, 1] and this variance below 1/12; differentiable by the implicit function theorem."""

    def excess(kappa: Array, mode: Array, variance: Array) -> Array:
        # One logarithm of a ratio near 1 is cheaper than five, whose digits would cancel.
        return jnp.log((1 + mode * kappa) / (2 + kappa) * ((1 + (1 - mode) * kappa) / (2 + kappa)) / ((3 + kappa) * variance))

    def slope(kappa: Array, mode: Array) -> Array:
        return mode / (1 + mode * kappa) + (1 - mode) / (1 + (1 - mode) * kappa) - 2 / (2 + kappa) - 1 / (3 + kappa)

    m, v = jax.lax.stop_gradient((mode, variance))

    def newton(_: Index, kappa: Array) -> Array:
        # In log(1 + κ) the logarithm of the variance is nearly linear, with a slope between -2 and -1/3.
        step = excess(kappa, m, v) / (slope(kappa, m) * (1 + kappa))
        return jnp.maximum((1 + kappa) * jnp.exp(-step) - 1, 0.0)

    solved = jax.lax.fori_loop(0, NEWTON_STEPS, newton, m * (1 - m) / v + jax.lax.rsqrt(v))
    return solved - excess(solved, mode, variance) / slope(solved, m)
