r"""Adaptation of Hamiltonian Monte Carlo in burn-in: the step size and, on request, the inverse mass matrix.

Chains may adapt together. Let $C$ be the covariance of their draws, and $F$ that of the scores $\nabla \log p$ at these draws. The geometric mean

$$M^{-1} = C \mathbin{\#} F^{-1} = L\, (L^\top F L)^{-1/2} L^\top, \quad C = L L^\top,$$

minimises the Fisher divergence to a Gaussian (Seyboldt, Carlson & Carpenter 2026). For a Gaussian it equals the covariance as soon as there are more
draws than dofs, wherever the chains are. So a short burn-in is enough. Each quarter of burn-in except the last estimates the matrix for the next
quarter. The estimate is made in units of the current matrix and shrunk towards it, as if by a few more draws. Then the step size is tuned again.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from bayes_body.base.shapes import Scalar

# The unit matrix counts as this many draws, as in Stan.
PRIOR_DRAWS = 5.0
# Number of transitions in the shortest burn-in that can estimate a matrix: two per quarter.
FEWEST = 8


class Plan(NamedTuple):
    """The settings of burn-in.

    Attributes:
        burn_in: number of transitions.
        target_acceptance: acceptance rate to which the step is tuned; with 0 the step is not tuned.
        adapts_mass: whether the inverse mass matrix is estimated.
        axes: names of the mapped axes along which chains adapt together.
    """

    burn_in: int
    target_acceptance: float
    adapts_mass: bool
    axes: tuple[str, ...] = ()


class Metric(NamedTuple):
    """The inverse mass matrix, and the sums over this quarter of burn-in.

    Attributes:
        units: Cholesky factor of the matrix.
        origin: mean of the chains' starts.
        moments: sum of the outer products of (1, draw, score), in those units.
    """

    units: Float[Array, "dof dof"]
    origin: Float[Array, " dof"]
    moments: Float[Array, "moment moment"]

    @property
    def inverse_mass(self) -> Float[Array, "dof dof"]:
        """Return the inverse mass matrix."""
        return self.units @ self.units.T


class AdaptationState(NamedTuple):
    """The results of burn-in so far.

    Attributes:
        step: step size of the next trajectory.
        tuning: blackjax's state of the dual averaging.
        metric: the adapted matrix; None if no matrix is adapted.
    """

    step: Scalar
    tuning: Any
    metric: Metric | None


def init(plan: Plan, step: Scalar, inverse_mass: Float[Array, " dof *dof"], position: Mapping[str, Array]) -> AdaptationState:
    """Return the state before the first transition.

    Args:
        plan: the settings of burn-in.
        step: initial size of a leapfrog step, in units of the mass matrix.
        inverse_mass: the matrix of this chain, diagonal or dense; chains that adapt together begin with the mean of their matrices.
        position: the start of this chain, in unconstrained coordinates.
    """
    if not plan.adapts_mass:
        return AdaptationState(step, _untuned(plan, step), None)
    dense = jnp.diag(inverse_mass) if inverse_mass.ndim == 1 else inverse_mass
    origin, common = _mean((ravel_pytree(dict(position))[0], dense), plan.axes)
    units = _factor(common, jnp.diag(jnp.sqrt(jnp.diagonal(common))))
    return AdaptationState(step, _untuned(plan, step), Metric(units, origin, jnp.zeros((2 * origin.size + 1,) * 2, origin.dtype)))


def update(plan: Plan, adapted: AdaptationState, index: Int[Array, ""], state: Any, acceptance: Scalar) -> AdaptationState:
    """Return the state after transition number `index`, counted from 0. Index -1 and transitions after burn-in change nothing.

    Args:
        plan: the settings of burn-in.
        adapted: the state before the transition.
        index: number of the transition.
        state: blackjax's state, including the gradient.
        acceptance: acceptance probability.
    """
    within = (index >= 0) & (index < plan.burn_in)
    if plan.target_acceptance:
        adapted = _with_step(plan, adapted, index, within, acceptance)
    if adapted.metric is None:
        return adapted
    metric = _with_draw(adapted.metric, within, state)
    quarter_ends = plan.burn_in * jnp.arange(1, 4) // 4
    return jax.lax.cond(jnp.any(index + 1 == quarter_ends), lambda: _with_matrix(plan, adapted, metric), lambda: adapted._replace(metric=metric))


def _mean[Tree](values: Tree, axes: tuple[str, ...]) -> Tree:
    # One axis after the other, since JAX cannot reduce over an axis of devices and another axis at once.
    for axis in axes:
        values = jax.lax.pmean(values, axis)
    return values


def _sum(values: Array, axes: tuple[str, ...]) -> Array:
    for axis in axes:
        values = jax.lax.psum(values, axis)
    return values


def _dual_averaging(plan: Plan) -> Any:
    from blackjax.adaptation.step_size import dual_averaging_adaptation

    return cast(Any, dual_averaging_adaptation)(plan.target_acceptance or 0.8)


def _untuned(plan: Plan, step: Scalar) -> Any:
    # blackjax pulls the step towards ten times its first value. Trajectories with such long steps would be rejected.
    return _dual_averaging(plan)[0](step / 10)


def _with_step(plan: Plan, adapted: AdaptationState, index: Array, within: Bool[Array, ""], acceptance: Scalar) -> AdaptationState:
    """Return the state with the step size tuned."""
    _, update, final = _dual_averaging(plan)
    tuned = update(adapted.tuning, _mean(acceptance, plan.axes))
    tuning = jax.tree.map(lambda new, old: jnp.where(within, new, old).astype(old.dtype), tuned, adapted.tuning)
    # During burn-in, the step depends on the last transition. Afterwards it is the average.
    step = jnp.where(index + 1 < plan.burn_in, jnp.exp(tuning.log_step_size), final(tuning))
    return adapted._replace(tuning=tuning, step=jnp.where(index < 0, adapted.step, step).astype(adapted.step.dtype))


def _with_draw(metric: Metric, within: Bool[Array, ""], state: Any) -> Metric:
    """Return the metric with a draw and its score added."""
    draw, score = (ravel_pytree(dict(part))[0] for part in (state.position, state.logdensity_grad))
    scaled = jax.scipy.linalg.solve_triangular(metric.units, draw - metric.origin, lower=True)
    row = jnp.concatenate([jnp.ones((1,), scaled.dtype), scaled, metric.units.T @ score])
    # A draw whose score is not finite is ignored.
    row = jnp.where(within & jnp.all(jnp.isfinite(row)), row, 0.0)
    return metric._replace(moments=metric.moments + row[:, None] * row)


def _with_matrix(plan: Plan, adapted: AdaptationState, metric: Metric) -> AdaptationState:
    """Return the state with the matrix of the quarter that ends here, if that matrix is positive definite."""
    units = _factor(metric.units @ geometric_mean(_sum(metric.moments, plan.axes)) @ metric.units.T, metric.units)
    new = AdaptationState(adapted.step, _untuned(plan, adapted.step), Metric(units, metric.origin, jnp.zeros_like(metric.moments)))
    # The loop needs the same types in every iteration.
    return jax.tree.map(lambda fresh, old: jnp.asarray(fresh, old.dtype), new, adapted)


def _factor(matrix: Float[Array, "dof dof"], otherwise: Float[Array, "dof dof"]) -> Float[Array, "dof dof"]:
    """Return the Cholesky factor if the matrix has one at this precision, else `otherwise`."""
    factor = jnp.linalg.cholesky(matrix)
    return jnp.where(jnp.all(jnp.isfinite(factor)), factor, otherwise)


def geometric_mean(moments: Float[Array, "moment moment"]) -> Float[Array, "dof dof"]:
    """Return C # F⁻¹ (Seyboldt, Carlson & Carpenter 2026, (9)). In each covariance the unit matrix counts as `PRIOR_DRAWS` draws.

    Args:
        moments: sum of the outer products of (1, draw, score).
    """
    dofs, count = moments.shape[0] // 2, moments[0, 0]
    mean = moments[0, 1:] / count
    scatter = moments[1:, 1:] - count * mean[:, None] * mean
    draws, scores = (
        (part + PRIOR_DRAWS * jnp.eye(dofs, dtype=part.dtype)) / (count + PRIOR_DRAWS) for part in (scatter[:dofs, :dofs], scatter[dofs:, dofs:])
    )
    factor = jnp.linalg.cholesky(draws)
    values, vectors = jnp.linalg.eigh(factor.T @ scores @ factor)
    root = factor @ (vectors * jnp.maximum(values, jnp.finfo(values.dtype).tiny) ** -0.25)
    return root @ root.T
