r"""The protocols that everything speaks: a model is a product of factors over named variables,

$$p(s_t, z_t \mid s_{t-1}) \propto p(s_t \mid s_{t-1}) \prod_f \psi_f(s_{\mathrm{scope}(f)}; z_t),$$

and a motion prior is a Transition, one normalised distribution that can both be drawn from and be evaluated.

A state is a mapping from a variable's name to its array. A kinematic-tree model has one variable, `pose`; a loose-limbed model has one a part;
a second-order prior carries the pose before. All are pytrees whose functions are static and whose arrays are leaves.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple, Protocol

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
    """The variables of this frame and, where given, of the frame before."""
    now = {Variable(name): value for name, value in state.items()}
    return now if previous is None else now | {Variable(name, -1): value for name, value in previous.items()}


@partial(
    jax.tree_util.register_dataclass, meta_fields=["name", "side", "scope", "has_gradient"], data_fields=["log_potential", "simulate", "curvature"]
)
@dataclass(frozen=True)
class Factor:
    """One term of the model.

    Attributes:
        name: unique in its model; also the key of what the factor needs of a frame's data.
        side: what a tempering kernel may do to it: only a likelihood is tempered, a constraint always holds at full power.
        scope: the variables that it reads, and no others reach it.
        log_potential: `(variables, data) -> scalar`; a `jax.tree_util.Partial`, so that its arrays are leaves of the model.
        has_gradient: whether its gradient tells where it grows; that of a nearest look-up is zero everywhere.
        simulate: `(key, variables) -> data`, a draw from the distribution over a frame's data whose normalised log-density `log_potential` is; a
            `jax.tree_util.Partial`. None where the factor is no such distribution.
        curvature: `(variables, data) -> by variable, about minus the second derivatives of log_potential by its entries, (entry, entry)`, with no
            negative eigenvalue, for the mass matrix of a sampler; a `jax.tree_util.Partial`. None where the factor has none of its own.
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
        """Whether it depends on the frame before, so that it differs between ancestors of one and the same state."""
        return any(variable.offset < 0 for variable in self.scope)


def sampled_only(previous: State, sampled: State) -> State:
    """The whole state is what was sampled: nothing is carried along."""
    del previous
    return sampled


def nothing_before(first: State) -> State:
    """The whole of a first state is what is sampled later: it remembers nothing."""
    return first


@partial(jax.tree_util.register_dataclass, meta_fields=["name"], data_fields=["conditional", "perturbation", "carry", "begin"])
@dataclass(frozen=True)
class Transition:
    """A motion prior.

    Attributes:
        name: as in the registry.
        conditional: previous state -> a numpyro Distribution for each variable, independent given the previous state, each with a scalar log_prob.
        perturbation: (state, scale) -> the same for the noise alone, centred on the state, its standard deviation multiplied by `scale`. It is a
            proposal of annealing kernels and never enters a density.
        carry: (previous, sampled) -> the whole state, with what is remembered but not random (the pose before, of a second-order prior).
        begin: the sampled variables of a first state -> the whole of it.
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
        """The state moved by the noise alone."""
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
    """Weighted states: every leaf of `states` has a leading particle axis; log-weights are normalised."""

    states: State
    log_weights: Float[Array, " particle"]


class FilterInfo(NamedTuple):
    """What a reader wants to know of one frame of one filter.

    Attributes:
        ancestors: for every particle, its index among the particles of the frame before.
        ess: effective sample size of the final weights, in particles.
        survival_rate: that as a share of the particles; one value a layer (a single one without layers).
        inverse_temperatures: the power of the likelihood at each layer.
        log_evidence: log of the estimate of p(z_t | z_1..t-1); NaN from a mode seeker.
        lost: no particle explained the frame; the filter went on from its prediction.
        acceptance_rate: share of a layer's Markov moves that were accepted, one value a layer; NaN from a kernel that makes none.
        evaluations: likelihoods of a whole pose that the frame took; one with its gradient counts as one.
        markov: of a kernel that runs Markov chains, how each went, (chain,): `acceptance`, `divergences`, `energy_fraction`, `step`; `ess` of each
            entry of a state, and the `length` of a chain, draws. Empty from any other.

    A kernel that chooses its number of layers pads what is one value a layer with NaN.
    """

    ancestors: Array
    ess: Scalar
    survival_rate: Array
    inverse_temperatures: Array
    log_evidence: Scalar
    lost: Array
    acceptance_rate: Array
    evaluations: Array
    markov: Mapping[str, Array] = {}  # nobody writes to it


class FrameDensity(Protocol):
    """What a kernel needs of a model at one frame; `bayes_body.density.density.Density` is one."""

    @property
    def transition(self) -> Transition:
        """The motion prior."""
        ...

    @property
    def reads_previous(self) -> bool:
        """Whether any factor depends on the frame before."""
        ...

    @property
    def without_gradient(self) -> tuple[str, ...]:
        """The likelihoods that have none."""
        ...

    @property
    def without_curvature(self) -> tuple[str, ...]:
        """The likelihoods that offer none."""
        ...

    def log_weight(self, state: State, previous: State) -> Scalar:
        """All factors but the transition, at full power."""
        ...

    def log_likelihood(self, state: State, previous: State) -> Scalar:
        """The likelihood side alone."""
        ...

    def log_constraint(self, state: State, previous: State) -> Scalar:
        """Constraints and the prior side's other factors: what tempering leaves alone."""
        ...

    @property
    def previous(self) -> Particles:
        """The particles of the frame before."""
        ...

    def given(self, previous: Particles) -> Any:
        """The same frame after other particles."""
        ...

    def ancestor(self, index: Any) -> State:
        """One particle of the frame before."""
        ...

    def ancestor_log_probs(self, state: State, predictions: Any = None) -> Array:
        """log p(i | s): from which particle of the frame before a state comes."""
        ...

    def unconstrained(self) -> Any:
        """The marginal view over coordinates without limits."""
        ...

    def curvature(self, state: State, previous: State) -> Mapping[str, Array]:
        """About minus the second derivatives by the entries of each variable, of the likelihoods that offer them."""
        ...

    def log_likelihood_of(self, names: Sequence[str], state: State, previous: State) -> Scalar:
        """The likelihoods of these names alone."""
        ...


class Kernel(Protocol):
    """From the particles of one frame to those of the next, given that frame's density; traced once for all frames."""

    def __call__(self, key: Key, particles: Particles, density: Any) -> tuple[Particles, FilterInfo]:
        """One frame."""
        ...
