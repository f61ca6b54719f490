r"""The Gaussian view of a frame's posterior: the prediction is one Gaussian in unconstrained coordinates (Kotecha & Djurić 2003).

$$\pi_{\alpha\beta}(u) \propto \mathcal{N}(u; m, V)\, C\, \psi^\alpha L^\beta,$$

where m and V are the mean and the covariance of the prediction. Only the variables that a factor reads are in u. The others, such as velocities, are
normal given u, and are drawn once u is known.

By the law of total covariance, with weights $w_i$ and the mean $m_i$ and the variances $v_i$ of the coordinates after particle i,

$$m = \sum_i w_i m_i, \qquad V = \sum_i w_i (m_i - m)(m_i - m)^T + \operatorname{diag} \sum_i w_i v_i.$$

If all entries of a state are independent given the particle, each entry's $m_i$ and $v_i$ are integrals over its own noise, by three Gauss-Hermite
nodes. They need its quantiles, the `icdf` of its distribution, and cost a tenth of draws. Otherwise the moments are those of `TRANSITIONS` draws for
each particle.

The extended view (density/extended.py) predicts by these transitions themselves. It is exact for the given particles. But in many dimensions only a
few particles explain the next image. After some frames all particles descend from one, and dofs that the images hardly determine keep its value. In
the Gaussian view, particles have no ancestors. The prediction loses its non-Gaussian shape.
"""

import itertools
import math
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpyro.distributions import Distribution, Independent

from bayes_body.base.errors import input_error
from bayes_body.base.shapes import Index, Key, Keys, Scalar
from bayes_body.density.chart import Chart
from bayes_body.density.density import Density
from bayes_body.density.factor import State, Transition, nothing_carried, nothing_derived
from bayes_body.density.tempering import LogTerms, tempered

# Added to the variances of the prediction, relative and absolute, so that the covariance has a root in float32.
FLOOR = (1e-4, 1e-10)
# Draws cost little, as no likelihood is evaluated. Resampled particles with one draw each would have chance correlations between dofs that the images
# determine and dofs that they do not; each new image would then push the latter at random.
TRANSITIONS = 32
# Nodes and weights of Gauss-Hermite quadrature, exact for polynomials up to the fifth degree of a standard normal number.
NODES, NODE_WEIGHTS = (-math.sqrt(3.0), 0.0, math.sqrt(3.0)), (1 / 6, 2 / 3, 1 / 6)
# With more coordinates than this, such as those of a pose and of unknowns, a product of matrices over many particles is faster than sums that XLA
# fuses with what surrounds them.
FUSED = 64


class Unread(NamedTuple):
    """The variables that no factor reads, given those that some factor reads: normal, in unconstrained coordinates.

    Attributes:
        mean: mean of the prediction.
        gain: the derivative of their mean with respect to the whitened coordinates of the others.
        root: a root of their covariance given the others.
        like: a position of these variables, for the shapes.
    """

    mean: Float[Array, " unread"]
    gain: Float[Array, "unread dof"]
    root: Float[Array, "unread unread"]
    like: State

    def position(self, noise: Float[Array, " dof"], own_noise: Float[Array, " unread"] | None = None) -> dict[str, Array]:
        """Return the position of the unread variables: their mean given the others' whitened coordinates, plus noise of their own."""
        centre = self.mean + product(self.gain, noise)
        return split(centre if own_noise is None else centre + product(self.root, own_noise), self.like)


class GaussianView(NamedTuple):
    """The Gaussian view. Create it with `gaussian_view`.

    Attributes:
        density: the density of the frame.
        coordinates: the unconstrained coordinates.
        mean: mean of the prediction in these coordinates.
        root: a root of its covariance.
        inverse_root: the inverse of the root.
        unread: the variables that no factor reads; None if there are none.
    """

    density: Density
    coordinates: Chart
    mean: Float[Array, " dof"]
    root: Float[Array, "dof dof"]
    inverse_root: Float[Array, "dof dof"]
    unread: Unread | None = None

    def state(self, ancestor: Index, position: State) -> State:
        """Return the whole state at a position, with unread variables at their mean. It takes nothing from its ancestor."""
        unread = {} if self.unread is None else self.unread.position(self.whitened(position))
        return self._complete_state(ancestor, {**position, **unread})

    def completed(self, noise: Float[Array, " unread"], ancestor: Index, position: State) -> State:
        """Return the whole state at a position, with a draw of the unread variables, made from standard normal noise."""
        unread = {} if self.unread is None else self.unread.position(self.whitened(position), noise)
        return self._complete_state(ancestor, {**position, **unread})

    @property
    def unread_size(self) -> int:
        """The number of unread coordinates."""
        return 0 if self.unread is None else self.unread.mean.shape[0]

    def _complete_state(self, ancestor: Index, position: State) -> State:
        return self.density.transition.state(self.density.ancestor(ancestor), self.coordinates.constrain(position))

    def whitened(self, position: State) -> Float[Array, " dof"]:
        """Return the whitened coordinates of a position: the inverse of `draw`."""
        return product(self.inverse_root, joined(position) - self.mean)

    def position(self, state: State) -> dict[str, Array]:
        """Return the position of a state."""
        unread = () if self.unread is None else self.unread.like
        return {name: value for name, value in self.coordinates.unconstrain(state).items() if name not in unread}

    def log_density(
        self, ancestor: Index, position: State, inverse_temperature: float | Scalar = 1.0, potential_power: float | Scalar = 1.0
    ) -> tuple[Scalar, LogTerms]:
        """Return log π_αβ(u) up to a constant, and both tempered terms. There is no Jacobian, because the Gaussian is a density over u."""
        state, previous = self.state(ancestor, position), self.density.ancestor(ancestor)
        terms = LogTerms(self.density.log_likelihood(state, previous), self.density.log_potential(state, previous))
        noise = self.whitened(position)
        prior = -0.5 * jnp.sum(noise * noise) + self.density.log_constraint(state, previous)
        potentials = potential_power * terms.potential if self.density.has_potentials else 0.0
        return prior + potentials + tempered(inverse_temperature, terms.likelihood), terms

    def state_at(self, noise: Float[Array, " dof"]) -> dict[str, Array]:
        """Return the variables that factors read, at whitened coordinates."""
        return self.density.transition.with_derived(self.coordinates.constrain(self.draw(noise)))

    def log_density_at(self, noise: Float[Array, " dof"]) -> Scalar:
        """Return log π_11 at whitened coordinates, up to the constant of a standard normal."""
        return self.density.log_weight(self.state_at(noise), self.density.ancestor(0)) - 0.5 * jnp.sum(noise * noise)

    def choose_ancestor(
        self, key: Key, ancestor: Index, position: State, inverse_temperature: float | Scalar, candidates: int, potential_power: float | Scalar = 1.0
    ) -> Index:
        """Return the ancestor. A state has none in this view: the index only says from which particle the draw of the prediction came."""
        del key, position, inverse_temperature, candidates, potential_power
        return ancestor

    def draw(self, noise: Float[Array, " dof"]) -> State:
        """Return a draw of the position from the prediction, made from standard normal noise."""
        return split(self.mean + product(self.root, noise), self.position(self.density.ancestor(0)))


# What needs a Gaussian prediction, and what to do where there can be none, in the user's words.
NEEDED_BY, REMEDY = 'prediction = "gaussian"', 'set prediction = "particles" in [kernel], or --set prediction=particles'


def gaussian_view(key: Key, density: Density, needed_by: str = NEEDED_BY, remedy: str = REMEDY) -> GaussianView:
    """Return the Gaussian view of a density, given the weighted particles of its previous frame.

    Args:
        key: random key, for a motion prior without quantiles.
        density: the density of the frame.
        needed_by: what needs the view, for an error message.
        remedy: what to do where there can be none.

    Raises:
        InputError: a factor reads the previous frame, or a state carries more from it than its sampled variables.
    """
    _check(density, needed_by, remedy)
    coordinates = density.coordinates()
    if has_quantiles(density.transition, density.ancestor(0)):
        mean, covariance = _moments_of_nodes(density, coordinates)
    else:
        mean, covariance = _moments_of_draws(key, density, coordinates)
    like = coordinates.unconstrain(density.ancestor(0))
    unread = {name: like[name] for name in _unread(density, sorted(like))}
    is_unread = np.concatenate([np.full(like[name].shape[0], name in unread) for name in sorted(like)])
    first, last = np.flatnonzero(~is_unread), np.flatnonzero(is_unread)
    root, inverse = _roots(covariance[jnp.ix_(first, first)])
    view = GaussianView(density, coordinates, mean[first], root, inverse)
    if not unread:
        return view
    gain = covariance[jnp.ix_(last, first)] @ inverse.T
    residual_root = jnp.linalg.cholesky(covariance[jnp.ix_(last, last)] - gain @ gain.T)
    return view._replace(unread=Unread(mean[last], gain, residual_root, unread))


type _Moments = tuple[Float[Array, " dof"], Float[Array, "dof dof"]]


def _moments_of_draws(key: Key, density: Density, coordinates: Chart) -> _Moments:
    """Return the mean and the covariance of the prediction from draws."""
    weights = jax.nn.softmax(density.previous.log_weights) / TRANSITIONS

    def transitions(keys: Keys, previous_state: State) -> Float[Array, "draw dof"]:
        draws = jax.vmap(lambda key: density.transition.sample(key, previous_state))(keys)
        return jax.vmap(lambda state: joined(coordinates.unconstrain(state)))(draws)

    drawn = jax.vmap(transitions)(jax.random.split(key, (weights.shape[0], TRANSITIONS)), dict(density.previous.states))
    return _fitted_moments(weights, drawn)


def _moments_of_nodes(density: Density, coordinates: Chart) -> _Moments:
    """Return the mean and the covariance of the prediction by quadrature."""
    weights = jax.nn.softmax(density.previous.log_weights)
    means, variances = jax.vmap(partial(moments_after, density.transition, coordinates))(dict(density.previous.states))
    mean, between = _fitted_moments(weights, means[:, None])
    return mean, between + (1 + FLOOR[0]) * jnp.diag(weights @ variances)


def moments_after(transition: Transition, coordinates: Chart, before: State) -> tuple[Float[Array, " dof"], Float[Array, " dof"]]:
    """Return the mean and the variance of each coordinate of the state after a state, by quadrature; the prior must have quantiles."""
    distributions = transition.conditional(before)
    states = [{name: _quantile(distribution, node) for name, distribution in distributions.items()} for node in NODES]
    nodes = jnp.stack([joined(coordinates.unconstrain(state)) for state in states])
    weights = jnp.array(NODE_WEIGHTS, nodes.dtype)
    mean = weights @ nodes
    return mean, weights @ (nodes - mean) ** 2


def _quantile(distribution: Distribution, node: float) -> Array:
    """Return the value of each independent entry at the level that a standard normal number has at a node."""
    base = distribution.base_dist if isinstance(distribution, Independent) else distribution
    return base.icdf(jnp.full(distribution.event_shape, 0.5 * math.erfc(-node / math.sqrt(2.0)), jnp.result_type(float)))


def has_quantiles(transition: Transition, state: State) -> bool:
    """Return whether a motion prior has quantiles of independent entries, in coordinates of one entry each. Of the state only the form matters."""
    if transition.chart is not None:
        return False
    try:
        jax.eval_shape(lambda state: {name: _quantile(d, 0.0) for name, d in transition.conditional(state).items()}, dict(state))
    except (NotImplementedError, ImportError):
        # numpyro takes the quantiles of some distributions from a package that need not be installed.
        return False
    return True


def _unread(density: Density, names: Sequence[str]) -> list[str]:
    """Return the sampled variables that are in no factor's scope. There are none if variables are derived, which may come from any of them."""
    transition = density.transition
    if getattr(transition.derive, "func", transition.derive) is not nothing_derived:
        return []
    scope = {variable.name for factor in density.factors for variable in factor.scope}
    unread = [name for name in names if name not in scope]
    return unread if len(unread) < len(names) else []


def fitted_gaussian(
    weights: Float[Array, " particle"], drawn: Float[Array, "particle draw dof"]
) -> tuple[Float[Array, " dof"], Float[Array, "dof dof"], Float[Array, "dof dof"]]:
    """Return the mean, a root of the covariance and the inverse of the root; `weights` is the weight of each draw of a particle."""
    mean, covariance = _fitted_moments(weights, drawn)
    return mean, *_roots(covariance)


def _fitted_moments(
    weights: Float[Array, " particle"], drawn: Float[Array, "particle draw dof"]
) -> tuple[Float[Array, " dof"], Float[Array, "dof dof"]]:
    mean = jnp.einsum("p,pkd->d", weights, drawn)
    centred = (drawn - mean) * jnp.sqrt(weights)[:, None, None]
    covariance = jnp.einsum("pkd,pke->de", centred, centred)
    relative, absolute = FLOOR
    return mean, covariance + jnp.diag(relative * jnp.diagonal(covariance) + absolute)


def _roots(covariance: Float[Array, "dof dof"]) -> tuple[Float[Array, "dof dof"], Float[Array, "dof dof"]]:
    """Return a root, and its inverse."""
    root = jnp.linalg.cholesky(covariance)
    return root, jax.scipy.linalg.solve_triangular(root, jnp.eye(root.shape[0], dtype=root.dtype), lower=True)


def product(matrix: Float[Array, "row dof"], vector: Float[Array, " dof"]) -> Float[Array, " row"]:
    """Return the product of a matrix, which all particles share, and one particle's vector."""
    return jnp.sum(matrix * vector, axis=-1) if matrix.shape[1] <= FUSED else jnp.matmul(matrix, vector, precision="highest")


def joined(position: State) -> Float[Array, " dof"]:
    """Return the coordinates of all variables as one vector, in the order of their names."""
    return jnp.concatenate([position[name] for name in sorted(position)])


def split(vector: Float[Array, " dof"], like: State) -> dict[str, Array]:
    """Return the coordinates of each variable: the inverse of `joined`, for variables with the shapes of `like`."""
    names = sorted(like)
    ends = list(itertools.accumulate(like[name].shape[0] for name in names))
    return dict(zip(names, jnp.split(vector, ends[:-1]), strict=True))


def _check(density: Density, needed_by: str, remedy: str) -> None:
    if density.reads_previous:
        name = next(factor.name for factor in density.factors if factor.reads_previous)
        raise input_error(needed_by, f"'{name}' compares a frame with the frame before", "a model whose terms read one frame", remedy)
    if getattr(density.transition.carry, "func", density.transition.carry) is not nothing_carried:
        problem = f"the dynamics '{density.transition.name}' carry more along than the sampled variables of one frame"
        raise input_error(needed_by, problem, "dynamics that depend on the pose of the frame before alone", remedy)
