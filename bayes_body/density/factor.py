r"""The language of models. A model is a product of factors over named variables,

$$p(s_t, z_t \mid s_{t-1}) \propto p(s_t \mid s_{t-1}) \prod_f \psi_f(s_{\mathrm{scope}(f)}; z_t),$$

and a motion prior is a Transition: one normalised distribution, to draw from and to evaluate.

A state is a mapping from a variable's name to its array. A kinematic-tree model has one variable, `pose`; a second-order prior also carries the pose
before. Factors and transitions are pytrees: their functions are static, their arrays are leaves.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from numpyro.distributions import Distribution

from bayes_body.shapes import Key, Scalar

type State = Mapping[str, Array]
type Data = Mapping[str, Any]
type Side = Literal["prior", "likelihood", "constraint"]


class Variable(NamedTuple):
    """A variable at a time offset: `Variable("pose")` now, `Variable("pose", -1)` one frame before."""

    name: str
    offset: int = 0


type Variables = Mapping[Variable, Array]


def variables(state: State, previous: State | None = None) -> dict[Variable, Array]:
    """The variables of this frame and, if `previous` is given, of the frame before."""
    now = {Variable(name): value for name, value in state.items()}
    return now if previous is None else now | {Variable(name, -1): value for name, value in previous.items()}


@partial(
    jax.tree_util.register_dataclass, meta_fields=["name", "side", "scope", "has_gradient"], data_fields=["log_potential", "simulate", "curvature"]
)
@dataclass(frozen=True)
class Factor:
    """One term of the model.

    Attributes:
        name: unique in its model; also the key of the factor's data of a frame.
        side: a tempering kernel tempers only likelihoods; a constraint always holds at full power.
        scope: the variables that it reads; it gets no others.
        log_potential: `(variables, data) -> scalar`; a `jax.tree_util.Partial`, so that its arrays are leaves of the model.
        has_gradient: whether its gradient is useful; that of a nearest look-up is zero everywhere.
        simulate: `(key, variables) -> data`, a draw of a frame's data from the distribution whose normalised log-density is `log_potential`; a
            `jax.tree_util.Partial`. None if the factor is not such a distribution.
        curvature: `(variables, data) -> matrices by variable`, for the mass matrix of a sampler: approximately minus the second derivatives of
            `log_potential`, (entry, entry), without negative eigenvalues; a `jax.tree_util.Partial`. None if the factor offers none.
    """

    name: str
    side: Side
    scope: tuple[Variable, ...]
    log_potential: Callable[[Variables, Any], Scalar]
    has_gradient: bool = True
    simulate: Callable[[Key, Variables], Any] | None = None
    curvature: Callable[[Variables, Any], Mapping[str, Array]] | None = None

    def __call__(self, values: Variables, data: Data) -> Scalar:
        """The log-potential of the scoped part of `values`, given the frame's data."""
        return self.log_potential({variable: values[variable] for variable in self.scope}, data.get(self.name))

    @property
    def reads_previous(self) -> bool:
        """Whether it depends on the frame before: then it differs between the ancestors of one state."""
        return any(variable.offset < 0 for variable in self.scope)


def sampled_only(previous: State, sampled: State) -> State:
    """Default `carry`: the whole state is sampled."""
    del previous
    return sampled


def nothing_before(first: State) -> State:
    """Default `begin`: the prior has no memory."""
    return first


@partial(jax.tree_util.register_dataclass, meta_fields=["name"], data_fields=["conditional", "perturbation", "carry", "begin"])
@dataclass(frozen=True)
class Transition:
    """A motion prior.

    Attributes:
        name: as in the registry.
        conditional: previous state -> a numpyro Distribution for each variable. The variables are independent given the previous state; each
            distribution has a scalar log_prob.
        perturbation: (state, scale) -> distributions of the noise, centred on the state, its standard deviation multiplied by `scale`. It is a
            proposal of annealing kernels and never enters a density.
        carry: (previous, sampled) -> the whole state, with variables that are remembered but not random (a second-order prior's pose before).
        begin: the sampled variables of a first state -> the whole state.
    """

    name: str
    conditional: Callable[[State], Mapping[str, Distribution]]
    perturbation: Callable[[State, Scalar], Mapping[str, Distribution]]
    carry: Callable[[State, State], State] = jax.tree_util.Partial(sampled_only)
    begin: Callable[[State], State] = jax.tree_util.Partial(nothing_before)

    def sample(self, key: Key, previous: State) -> State:
        """One state of the next frame."""
        return self.carry(previous, draw(key, self.conditional(previous)))

    def perturb(self, key: Key, state: State, previous: State, scale: Scalar) -> State:
        """The state moved by the noise."""
        return self.carry(previous, draw(key, self.perturbation(state, scale)))

    def log_density(self, state: State, previous: State) -> Scalar:
        """log p(state | previous), normalised over the support."""
        terms = [jnp.asarray(d.log_prob(state[name])) for name, d in self.conditional(previous).items()]
        return sum(terms, jnp.zeros(()))


def draw(key: Key, distributions: Mapping[str, Distribution]) -> dict[str, Array]:
    """One value of each variable."""
    keys = jax.random.split(key, len(distributions))
    return {name: jnp.asarray(distributions[name].sample(k)) for name, k in zip(sorted(distributions), keys, strict=True)}


class Particles(NamedTuple):
    """Weighted states: every leaf of `states` has a leading particle axis; the log-weights are normalised."""

    states: State
    log_weights: Float[Array, " particle"]
