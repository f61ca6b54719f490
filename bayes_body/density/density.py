r"""The posterior density of a frame, and its marginal view.

Given the weighted particles $(w_i, s^i_{t-1})$ of the previous frame, the posterior of a frame is

$$\ell(i, s_t) = \log w_i + \log p(s_t \mid s^i_{t-1}) + \alpha \log \psi(s_t) + \beta \log L(s_t; z_t, s^i_{t-1}, z_{t-1}) + \log C(s_t),$$

with the potentials ψ of the prior, such as the joints of a loose-limbed body, and the constraints C, which are never tempered.

The *marginal* view sums over the ancestor $i$: $\log \sum_i \exp \ell(i, s_t)$, the target of Poon & Fleet's HMC (14). The *extended* view
(density/extended.py) keeps the ancestor as a variable, for particle filters and tempered SMC. Both call the same factors, use the same coordinates
(density/coordinates.py) and temper by the same rule (density/tempering.py). Message passing reads plates (density/parts_graph.py).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from numpyro.distributions import Distribution

from bayes_body.base.errors import input_error
from bayes_body.base.shapes import Index, Key, Scalar
from bayes_body.density.chart import Chart
from bayes_body.density.coordinates import coordinates_after
from bayes_body.density.factor import Data, Factor, Particles, Side, State, Transition, variables
from bayes_body.density.tempering import LogTerms, tempered

# For each variable, a batch of distributions: one for each particle of the previous frame.
type Predictions = Mapping[str, Distribution]


@partial(jax.tree_util.register_dataclass, meta_fields=[], data_fields=["transition", "factors", "data", "previous", "proposals"])
@dataclass(frozen=True, eq=False)
class Density:
    """The posterior of one frame. It is a pytree: with a new frame's images or particles, a compiled function of it is not traced again.

    Attributes:
        transition: the motion prior.
        factors: all other terms.
        data: the data of this frame that the factors need, by factor name.
        previous: the particles of the previous frame.
        proposals: distributions of entries of a plated variable (`graph.Mixture`), such as detections. They say where to look and are not terms of
            the density.
    """

    transition: Transition
    factors: tuple[Factor, ...]
    data: Data
    previous: Particles
    proposals: tuple[Any, ...] = ()

    def __call__(self, state: State) -> Scalar:
        """Return the log-posterior of a state in the marginal view, up to the evidence."""
        return self.marginal(state)

    def with_previous(self, previous: Particles) -> "Density":
        """Return the density of the same frame with other particles of the previous frame."""
        return replace(self, previous=previous)

    def ancestor(self, index: int | Index) -> State:
        """Return one particle of the previous frame."""
        return jax.tree.map(lambda leaf: leaf[index], self.previous.states)

    @property
    def reads_previous(self) -> bool:
        """Whether any factor depends on the previous frame."""
        return any(factor.reads_previous for factor in self.factors)

    @property
    def without_gradient(self) -> tuple[str, ...]:
        """The names of the likelihoods without a useful gradient, which a gradient-based kernel cannot use."""
        return tuple(factor.name for factor in self.factors if factor.side == "likelihood" and not factor.has_gradient)

    @property
    def without_curvature(self) -> tuple[str, ...]:
        """The names of the likelihoods without a curvature. For a mass matrix, their curvature is computed by differences of gradients."""
        return tuple(factor.name for factor in self.factors if factor.side == "likelihood" and factor.curvature is None)

    @property
    def not_generative(self) -> tuple[str, ...]:
        """The names of the likelihoods that are not a distribution over a frame's data, so that data cannot be simulated from them."""
        return tuple(factor.name for factor in self.factors if factor.side == "likelihood" and factor.simulate is None)

    def simulate(self, key: Key, state: State, previous: State | None = None) -> Data:
        """Draw a frame's data given a state and the state of the previous frame (by default its first particle).

        Raises:
            InputError: a likelihood is not generative.
        """
        if self.not_generative:
            expected = "a model whose likelihoods are all distributions over a frame's data"
            raise input_error(
                "the likelihood", f"'{self.not_generative[0]}' is not a distribution over images", expected, "take markers_gaussian, for one"
            )
        values = variables(state, self.ancestor(0) if previous is None else previous)
        likelihoods = [factor for factor in self.factors if factor.side == "likelihood"]
        keys = jax.random.split(key, len(likelihoods))
        drawn = {f.name: f.simulate(k, {v: values[v] for v in f.scope}) for f, k in zip(likelihoods, keys, strict=True) if f.simulate}
        return {**self.data, **drawn}

    def side(self, side: Side, state: State, previous: State) -> Scalar:
        """Return the sum of the factors of one side."""
        return self._sum([factor for factor in self.factors if factor.side == side], state, previous)

    def log_likelihood(self, state: State, previous: State) -> Scalar:
        """Return the sum of the log-likelihoods, the part that tempering affects."""
        return self.side("likelihood", state, previous)

    def log_constraint(self, state: State, previous: State) -> Scalar:
        """Return the sum of the constraints, which are never tempered."""
        return self.side("constraint", state, previous)

    def log_potential(self, state: State, previous: State) -> Scalar:
        """Return the sum of the prior's factors other than the transition."""
        return self.side("prior", state, previous)

    @property
    def has_potentials(self) -> bool:
        """Whether the prior has factors other than the transition."""
        return any(factor.side == "prior" for factor in self.factors)

    def links(self, state: State, previous: State) -> Scalar:
        """Return the sum of the factors that depend on the previous frame."""
        return self._sum([factor for factor in self.factors if factor.reads_previous], state, previous)

    def log_weight(self, state: State, previous: State) -> Scalar:
        """Return all terms but the transition: the log-weight of a particle drawn from the transition."""
        return self._sum(self.factors, state, previous)

    def log_joint(
        self, state: State, previous: State, inverse_temperature: float | Scalar = 1.0, potential_power: float | Scalar = 1.0
    ) -> tuple[Scalar, LogTerms]:
        r"""Return log p(s | previous) + log C + α log ψ + β log L, and log L and log ψ; β = `inverse_temperature`, α = `potential_power`."""
        terms = LogTerms(self.log_likelihood(state, previous), self.log_potential(state, previous))
        prior = self.transition.log_density(state, previous) + self.log_constraint(state, previous)
        # Without potentials the power is not even traced.
        potentials = potential_power * terms.potential if self.has_potentials else 0.0
        return prior + potentials + tempered(inverse_temperature, terms.likelihood), terms

    def curvature(self, state: State, previous: State) -> dict[str, Array]:
        """Return approximately minus the second derivatives of the likelihoods that have a curvature, by variable: (entry, entry)."""
        values, total = variables(state, previous), {name: jnp.zeros((value.size, value.size), value.dtype) for name, value in state.items()}
        for factor in self.factors:
            if factor.side == "likelihood" and factor.curvature is not None:
                curvatures = factor.curvature({v: values[v] for v in factor.scope}, self.data.get(factor.name))
                total = {name: value + curvatures[name] if name in curvatures else value for name, value in total.items()}
        return total

    def log_likelihood_of(self, names: Sequence[str], state: State, previous: State) -> Scalar:
        """Return the sum of the log-likelihoods with these names."""
        return self._sum([factor for factor in self.factors if factor.name in names], state, previous)

    def parts(self, state: State, previous: State | None = None) -> dict[str, Scalar]:
        """Return the log-potential of each factor and of the transition, by name. `previous` defaults to the first particle of the previous frame."""
        previous_state = self.ancestor(0) if previous is None else previous
        values = variables(state, previous_state)
        terms = {factor.name: factor(values, self.data) for factor in self.factors}
        return {"transition": self.transition.log_density(state, previous_state)} | terms

    def _sum(self, factors: list[Factor] | tuple[Factor, ...], state: State, previous: State) -> Scalar:
        values = variables(state, previous)
        return sum((factor(values, self.data) for factor in factors), jnp.zeros(()))

    # -- the marginal view --------------------------------------------------------------------------------------------------------------

    def marginal(self, state: State, inverse_temperature: float | Scalar = 1.0, predictions: Predictions | None = None) -> Scalar:
        r"""Return $\log \sum_i \exp \ell(i, s_t)$. If many states are evaluated, pass `predictions` from `self.predictions()`."""
        by_ancestor = self.by_ancestor(state, inverse_temperature, predictions)
        # A factor that does not read the previous frame is the same for all ancestors. It is evaluated once, outside the sum.
        shared = [factor for factor in self.factors if not factor.reads_previous]
        common = self._tempered_sum(shared, state, self.ancestor(0), inverse_temperature)
        return (by_ancestor[0] if by_ancestor.shape == (1,) else jax.nn.logsumexp(by_ancestor)) + common

    def predictions(self) -> Predictions:
        """Return the motion prior given each particle of the previous frame, by variable: distributions with a leading particle axis.

        Terms that depend only on the previous frame are computed here, once for all states.
        """
        return jax.vmap(self.transition.conditional)(self.previous.states)

    def ancestor_log_probs(self, state: State, predictions: Predictions | None = None) -> Float[Array, " particle"]:
        """Return log p(i | s_t), where i is the state's ancestor among the particles of the previous frame; `predictions` as in `marginal`."""
        return jax.nn.log_softmax(self.by_ancestor(state, 1.0, predictions))

    def by_ancestor(
        self, state: State, inverse_temperature: float | Scalar = 1.0, predictions: Predictions | None = None
    ) -> Float[Array, " particle"]:
        """Return, for each ancestor, the terms of the log-density that depend on the ancestor."""
        linking = [factor for factor in self.factors if factor.reads_previous]
        distributions = self.predictions() if predictions is None else predictions
        links = sum((_log_prob_each(distribution, state[name]) for name, distribution in distributions.items()), self.previous.log_weights)
        if not linking:
            return links
        return links + jax.vmap(lambda previous_state: self._tempered_sum(linking, state, previous_state, inverse_temperature))(self.previous.states)

    def _tempered_sum(self, factors: Sequence[Factor], state: State, previous_state: State, inverse_temperature: float | Scalar) -> Scalar:
        likelihood = self._sum([f for f in factors if f.side == "likelihood"], state, previous_state)
        prior = self._sum([f for f in factors if f.side != "likelihood"], state, previous_state)
        return prior + tempered(inverse_temperature, likelihood)

    def coordinates(self) -> Chart:
        """Return unconstrained coordinates for the sampled variables, the same for every ancestor."""
        return coordinates_after(self.transition, self.ancestor(0))

    def unconstrained(self) -> "Unconstrained":
        """Return the marginal view in unconstrained coordinates, for gradient-based samplers."""
        return Unconstrained(self, self.coordinates(), self.predictions())


class Unconstrained(NamedTuple):
    r"""The marginal log-density of a position: $x \mapsto \log \sum_i \exp \ell(i, s(x)) + \log |\det \partial s / \partial x|$.

    A position maps each sampled variable to an unconstrained array. Call this object with a position, or give it to a sampler as its log-density:

        target = density.unconstrained()
        value, gradient = jax.value_and_grad(target)(target.unconstrain(model.initial))

    Attributes:
        density: the density of the frame.
        coordinates: the unconstrained coordinates.
        predictions: the motion prior given each particle of the previous frame, computed once.
    """

    density: Density
    coordinates: Chart
    predictions: Predictions

    def __call__(self, position: State) -> Scalar:
        """Return the log-density at a position, including the Jacobian."""
        return self.density.marginal(self.constrain(position), predictions=self.predictions) + self.coordinates.log_determinant(position)

    def constrain(self, position: State) -> dict[str, Array]:
        """Return the sampled variables of the state at a position, and those that follow from them."""
        return self.density.transition.with_derived(self.coordinates.constrain(position))

    def unconstrain(self, state: State) -> dict[str, Array]:
        """Return the position of a state: the inverse of `constrain`."""
        return self.coordinates.unconstrain(state)

    def complete(self, key: Key, position: State) -> tuple[State, Index]:
        """Return the whole state at a position, and its ancestor, drawn from p(i | s). The variables that are not sampled come from the ancestor."""
        return self.completed(key, self.constrain(position))

    def completed(self, key: Key, sampled: State) -> tuple[State, Index]:
        """Return the whole state with these sampled variables, and its ancestor, as `complete` does."""
        ancestor = jax.random.categorical(key, self.density.ancestor_log_probs(sampled, self.predictions))
        return self.density.transition.carry(self.density.ancestor(ancestor), sampled), ancestor


def _log_prob_each(distributions: Distribution, value: Array) -> Float[Array, " particle"]:
    """Return the log-densities of one value under a batch of distributions, by their faster method `log_prob_each` if they have one."""
    shared = getattr(distributions, "log_prob_each", None)
    return shared(value) if shared else jax.vmap(lambda distribution: jnp.asarray(distribution.log_prob(value)))(distributions)
