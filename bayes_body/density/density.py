r"""The model, written once, and its views.

With the weighted particles $(w_i, s^i_{t-1})$ of the frame before, the posterior of a frame is

$$\ell(i, s_t) = \log w_i + \log p(s_t \mid s^i_{t-1}) + \beta \log L(s_t; z_t, s^i_{t-1}, z_{t-1}) + \log C(s_t),$$

seen *extended* (the ancestor $i$ fixed or sampled too: particle filters, tempered SMC) or *marginal* ($\log \sum_i \exp \ell(i, s_t)$: Poon &
Fleet's (14) under HMC). Both views call the same factors; so do the single-variable views of belief propagation.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from numpyro.distributions import Distribution, biject_to
from numpyro.distributions.transforms import Transform

from bayes_body.density.factor import Data, Factor, Particles, Side, State, Transition, Variable, variables
from bayes_body.errors import input_error
from bayes_body.shapes import Index, Key, Scalar

# By variable, a distribution for each particle of the frame before.
type Predictions = Mapping[str, Distribution]


@partial(jax.tree_util.register_dataclass, meta_fields=[], data_fields=["transition", "factors", "data", "previous"])
@dataclass(frozen=True, eq=False)
class Density:
    """The posterior of one frame: a pytree, so that a new frame's images or particles never retrace what consumes it.

    Attributes:
        transition: the motion prior.
        factors: everything else.
        data: what the factors need of this frame, by factor name.
        previous: the particles of the frame before.
    """

    transition: Transition
    factors: tuple[Factor, ...]
    data: Data
    previous: Particles

    def __call__(self, state: State) -> Scalar:
        """The log-posterior of a state, up to the evidence: the marginal view."""
        return self.marginal(state)

    def given(self, previous: Particles) -> "Density":
        """The same frame after other particles."""
        return replace(self, previous=previous)

    def ancestor(self, index: int | Index) -> State:
        """One particle of the frame before."""
        return jax.tree.map(lambda leaf: leaf[index], self.previous.states)

    @property
    def reads_previous(self) -> bool:
        """Whether any factor depends on the frame before."""
        return any(factor.reads_previous for factor in self.factors)

    @property
    def without_gradient(self) -> tuple[str, ...]:
        """The likelihoods that have none: a gradient-based kernel would move blindly."""
        return tuple(factor.name for factor in self.factors if factor.side == "likelihood" and not factor.has_gradient)

    @property
    def without_curvature(self) -> tuple[str, ...]:
        """The likelihoods that offer none: their gradients are differenced for a mass matrix."""
        return tuple(factor.name for factor in self.factors if factor.side == "likelihood" and factor.curvature is None)

    @property
    def not_generative(self) -> tuple[str, ...]:
        """The likelihoods that are no distribution over a frame's data: nothing can be simulated from them."""
        return tuple(factor.name for factor in self.factors if factor.side == "likelihood" and factor.simulate is None)

    def simulate(self, key: Key, state: State, previous: State | None = None) -> Data:
        """A frame's data drawn given a state (after `previous`, by default the first particle of the frame before).

        Raises:
            InputError: a likelihood is not generative.
        """
        if self.not_generative:
            expected = "a model whose likelihoods are all generative"
            raise input_error(
                "the likelihood", f"'{self.not_generative[0]}' is no distribution over images", expected, "take markers_gaussian, for one"
            )
        values = variables(state, self.ancestor(0) if previous is None else previous)
        likelihoods = [factor for factor in self.factors if factor.side == "likelihood"]
        keys = jax.random.split(key, len(likelihoods))
        drawn = {f.name: f.simulate(k, {v: values[v] for v in f.scope}) for f, k in zip(likelihoods, keys, strict=True) if f.simulate}
        return {**self.data, **drawn}

    # -- the sides ----------------------------------------------------------------------------------------------------------------------

    def side(self, side: Side, state: State, previous: State) -> Scalar:
        """The sum of the factors of one side."""
        return self._sum([factor for factor in self.factors if factor.side == side], state, previous)

    def log_prior(self, state: State, previous: State) -> Scalar:
        """log p(state | previous) with the prior side's other factors."""
        return self.transition.log_density(state, previous) + self.side("prior", state, previous)

    def log_likelihood(self, state: State, previous: State) -> Scalar:
        """The likelihood side: what tempering tempers."""
        return self.side("likelihood", state, previous)

    def log_constraint(self, state: State, previous: State) -> Scalar:
        """What holds at full power besides the transition: constraints, and the prior side's other factors."""
        return self.side("constraint", state, previous) + self.side("prior", state, previous)

    def log_weight(self, state: State, previous: State) -> Scalar:
        """Everything but the transition: the weight of a particle drawn from it."""
        return self._sum(self.factors, state, previous)

    def curvature(self, state: State, previous: State) -> dict[str, Array]:
        """About minus the second derivatives by the entries of each variable, of the likelihoods that offer them."""
        values, total = variables(state, previous), {name: jnp.zeros((value.size, value.size), value.dtype) for name, value in state.items()}
        for factor in self.factors:
            if factor.side == "likelihood" and factor.curvature is not None:
                found = factor.curvature({v: values[v] for v in factor.scope}, self.data.get(factor.name))
                total = {name: value + found[name] if name in found else value for name, value in total.items()}
        return total

    def log_likelihood_of(self, names: Sequence[str], state: State, previous: State) -> Scalar:
        """The likelihoods of these names alone."""
        return self._sum([factor for factor in self.factors if factor.name in names], state, previous)

    def parts(self, state: State, previous: State | None = None) -> dict[str, Scalar]:
        """The log-potential of each factor by name, and the transition's. Without `previous` the first particle of the frame before is taken."""
        before = self.ancestor(0) if previous is None else previous
        values = variables(state, before)
        terms = {factor.name: factor(values, self.data) for factor in self.factors}
        return {"transition": self.transition.log_density(state, before)} | terms

    def _sum(self, factors: list[Factor] | tuple[Factor, ...], state: State, previous: State) -> Scalar:
        values = variables(state, previous)
        return sum((factor(values, self.data) for factor in factors), jnp.zeros(()))

    # -- the views ----------------------------------------------------------------------------------------------------------------------

    def extended(self, ancestor: int | Index, state: State, inverse_temperature: float | Scalar = 1.0) -> Scalar:
        r"""$\ell(i, s_t)$, with $\beta$ = `inverse_temperature` on the likelihood side only."""
        before = self.ancestor(ancestor)
        prior = self.previous.log_weights[ancestor] + self.transition.log_density(state, before)
        return prior + self.log_constraint(state, before) + _tempered(inverse_temperature, self.log_likelihood(state, before))

    def marginal(self, state: State, inverse_temperature: float | Scalar = 1.0, predictions: Predictions | None = None) -> Scalar:
        r"""$\log \sum_i \exp \ell(i, s_t)$; `predictions` as `self.predictions()` makes them, where many states are evaluated."""
        each = self._by_ancestor(state, inverse_temperature, predictions)
        # A factor that does not read the frame before is the same for all ancestors: it is evaluated once, outside the sum.
        shared = [factor for factor in self.factors if not factor.reads_previous]
        common = self._powered(shared, state, self.ancestor(0), inverse_temperature)
        return (each[0] if each.shape == (1,) else jax.nn.logsumexp(each)) + common

    def predictions(self) -> Predictions:
        """The motion prior after each particle of the frame before, by variable: distributions with a leading particle axis.

        What of them depends on the frame before alone is computed here, once for all states.
        """
        return jax.vmap(self.transition.conditional)(self.previous.states)

    def ancestor_log_probs(self, state: State, predictions: Predictions | None = None) -> Float[Array, " particle"]:
        """log p(i | s_t): from which particle of the frame before a state comes; draws of the marginal view take their ancestor from it.

        `predictions` as in `marginal`.
        """
        return jax.nn.log_softmax(self._by_ancestor(state, 1.0, predictions))

    def _by_ancestor(self, state: State, inverse_temperature: float | Scalar, predictions: Predictions | None = None) -> Float[Array, " particle"]:
        """What of the log-density differs between ancestors."""
        own = [factor for factor in self.factors if factor.reads_previous]
        laws = self.predictions() if predictions is None else predictions
        links = sum((_log_prob_each(law, state[name]) for name, law in laws.items()), self.previous.log_weights)
        return links + jax.vmap(lambda before: self._powered(own, state, before, inverse_temperature))(self.previous.states) if own else links

    def _powered(self, factors: Sequence[Factor], state: State, before: State, inverse_temperature: float | Scalar) -> Scalar:
        likelihood = self._sum([f for f in factors if f.side == "likelihood"], state, before)
        rest = self._sum([f for f in factors if f.side != "likelihood"], state, before)
        return rest + _tempered(inverse_temperature, likelihood)

    def reading(self, variable: Variable) -> tuple[Factor, ...]:
        """The factors in whose scope a variable is: what a belief-propagation node multiplies."""
        return tuple(factor for factor in self.factors if variable in factor.scope)

    def unconstrained(self) -> "Unconstrained":
        """The marginal view over coordinates without limits, for gradient-based kernels."""
        supports = self.transition.conditional(self.ancestor(0))
        return Unconstrained(self, {name: biject_to(distribution.support) for name, distribution in supports.items()}, self.predictions())


class Unconstrained(NamedTuple):
    r"""$x \mapsto \ell(s(x)) + \log |\det \partial s / \partial x|$, with the bijections that belong to the transition's support."""

    density: Density
    bijections: dict[str, Transform]
    predictions: Predictions

    def constrain(self, position: State) -> dict[str, Array]:
        """From coordinates without limits to the state's own."""
        return {name: jnp.asarray(self.bijections[name](value)) for name, value in position.items()}

    def unconstrain(self, state: State) -> dict[str, Array]:
        """The inverse of `constrain`."""
        return {name: jnp.asarray(bijection.inv(state[name])) for name, bijection in self.bijections.items()}

    def log_determinant(self, position: State) -> Scalar:
        """log |det ds/dx|: without it the density would be over x, not over the state."""
        state = self.constrain(position)
        terms = (jnp.sum(self.bijections[name].log_abs_det_jacobian(x, state[name])) for name, x in position.items())
        return sum(terms, jnp.zeros(()))

    def __call__(self, position: State, view: Callable[[State], Scalar] | None = None) -> Scalar:
        """The log-density of coordinates without limits; `view` replaces the marginal one (say, an extended view of one ancestor)."""
        state = self.constrain(position)
        log_density = self.density.marginal(state, predictions=self.predictions) if view is None else view(state)
        return log_density + self.log_determinant(position)


def _log_prob_each(laws: Distribution, value: Array) -> Float[Array, " particle"]:
    """The log-densities of one value under a batch of laws, by the law's own `log_prob_each` where it shares work between them."""
    own = getattr(laws, "log_prob_each", None)
    return own(value) if own else jax.vmap(lambda law: jnp.asarray(law.log_prob(value)))(laws)


def _tempered(inverse_temperature: float | Scalar, log_likelihood: Scalar) -> Scalar:
    # 0 · (−inf) is NaN; at temperature infinity the likelihood says nothing, whatever it is.
    hot = jnp.asarray(inverse_temperature) == 0
    return jnp.where(hot, 0.0, inverse_temperature * jnp.where(hot, 0.0, log_likelihood))
