r"""The terms of a model. A model is a product of factors over named variables,

$$p(s_t, z_t \mid s_{t-1}) \propto p(s_t \mid s_{t-1}) \prod_f \psi_f(s_{\mathrm{scope}(f)}; z_t),$$

and a motion prior is a Transition: one normalised distribution that can be sampled and evaluated.

A state maps a variable's name to its array. A kinematic-tree model has one variable, `pose`. A second-order prior also carries the previous pose.
Factors and transitions are pytrees: their functions are static, their arrays are leaves.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from numpyro.distributions import Distribution

from bayes_body.base.shapes import Key, Scalar
from bayes_body.density.spaces import Flat, Space, numbered

type State = Mapping[str, Array]
type Data = Mapping[str, Any]
type Side = Literal["prior", "likelihood", "constraint"]


class Variable(NamedTuple):
    """A variable at a time offset: `Variable("pose")` in this frame, `Variable("pose", -1)` in the previous frame."""

    name: str
    offset: int = 0


type Variables = Mapping[Variable, Array]


def variables(state: State, previous: State | None = None) -> dict[Variable, Array]:
    """Return the variables of this frame and, if `previous` is given, of the previous frame."""
    current = {Variable(name): value for name, value in state.items()}
    return current if previous is None else current | {Variable(name, -1): value for name, value in previous.items()}


class Numbered(NamedTuple):
    """Cameras or markers by number: those of the rows along an axis, or those that the entries of a variable move.

    Attributes:
        kind: such as `"camera"` or `"marker"`.
        numbers: the number of the camera or marker at each place.
    """

    kind: str
    numbers: tuple[int, ...]


@partial(jax.tree_util.register_dataclass, meta_fields=["axes", "local"], data_fields=["inner", "outer"])
@dataclass(frozen=True)
class Composed:
    """A log-potential that compares rows of numbers with data: the sum of `outer(inner(variables), data)`.

    Kinematics and cameras are in `inner`, and what a row costs is in `outer`. Kernels that need second derivatives compute those of `outer` alone,
    and take `inner` as linear (density/expansion.py).

    Attributes:
        inner: `variables -> (*row, entry)`, such as the expected pixels of points, (camera, point, 2); a `jax.tree_util.Partial`.
        outer: `((*row, entry), data) -> (*row,)`, the log-potential of each row, which depends on this row alone; a `jax.tree_util.Partial`.
        axes: what the rows belong to along each of their axes; empty if a row does not belong to one camera or one marker.
        local: variables of which each entry changes only the rows of one camera or marker, which makes derivatives cheaper; may be empty.
    """

    inner: Callable[[Variables], Array]
    outer: Callable[[Array, Any], Array]
    axes: tuple[Numbered, ...] = ()
    local: tuple[tuple[Variable, Numbered], ...] = ()

    def __call__(self, values: Variables, data: Any) -> Scalar:
        """Return the log-potential of the variables, given a frame's data."""
        return jnp.sum(self.outer(self.inner(values), data))


@partial(
    jax.tree_util.register_dataclass, meta_fields=["name", "side", "scope", "has_gradient"], data_fields=["log_potential", "simulate", "curvature"]
)
@dataclass(frozen=True)
class Factor:
    """One term of the model.

    Attributes:
        name: unique in its model; also the key of the factor's data in a frame's data.
        side: a tempering kernel tempers only likelihoods; a constraint always applies at full power.
        scope: the variables that it reads; it is given no others.
        log_potential: `(variables, data) -> scalar`; a `jax.tree_util.Partial`, so that its arrays are leaves of the model, or a `Composed`.
        has_gradient: whether its gradient is useful; for example, the gradient of a nearest look-up is zero everywhere.
        simulate: `(key, variables) -> data`, which draws a frame's data from the distribution whose normalised log-density is `log_potential`; a
            `jax.tree_util.Partial`. None if the factor is not such a distribution.
        curvature: `(variables, data) -> matrices by variable`, for the mass matrix of a sampler: approximately minus the second derivatives of
            `log_potential`, (entry, entry), without negative eigenvalues; a `jax.tree_util.Partial`. None if the factor has none.
    """

    name: str
    side: Side
    scope: tuple[Variable, ...]
    log_potential: Callable[[Variables, Any], Scalar]
    has_gradient: bool = True
    simulate: Callable[[Key, Variables], Any] | None = None
    curvature: Callable[[Variables, Any], Mapping[str, Array]] | None = None

    def __call__(self, values: Variables, data: Data) -> Scalar:
        """Return the log-potential of the `values` that are in the scope, given the frame's data."""
        return self.log_potential({variable: values[variable] for variable in self.scope}, data.get(self.name))

    @property
    def reads_previous(self) -> bool:
        """Whether the factor depends on the previous frame, and so differs between the ancestors of a state."""
        return any(variable.offset < 0 for variable in self.scope)


def nothing_derived(sampled: State) -> State:
    """Return no variables: the default `derive`, for a state that is sampled as a whole."""
    del sampled
    return {}


def nothing_carried(previous: State, sampled: State) -> State:
    """Return these variables unchanged: the default `carry`, for a prior without memory."""
    del previous
    return sampled


def nothing_before(first: State) -> State:
    """Return the first state: the default `begin`, for a prior without memory."""
    return first


@partial(
    jax.tree_util.register_dataclass,
    meta_fields=["name", "spaces", "memory"],
    data_fields=["conditional", "perturbation", "carry", "begin", "first", "derive", "chart", "explore"],
)
@dataclass(frozen=True)
class Transition:
    """A motion prior.

    Attributes:
        name: its name in the registry.
        conditional: previous state -> a numpyro Distribution for each variable. The variables are independent given the previous state; each
            distribution has a scalar log_prob.
        perturbation: (state, scale) -> distributions of the noise, centred on the state, with the standard deviation multiplied by `scale`. It is a
            proposal of annealing kernels and is not part of the density.
        carry: (previous, sampled and derived variables) -> the whole state, including variables that are remembered but not random (such as the
            previous pose of a second-order prior).
        begin: a first pose -> the whole state.
        first: a state of `begin` -> a distribution for each variable that the first pose leaves open, such as its velocity; None: there is no such
            variable.
        derive: sampled variables -> the variables that follow from them alone, such as the pose at a phase of a walking cycle. Factors read
            these like any others, and derivatives go through this function.
        chart: previous state -> coordinates without limits for the sampled variables (density/chart.py), the same for every previous state of a
            frame; None: one bijection for each variable, onto the support of its distribution.
        explore: (key, state, previous, scale) -> sampled variables: the proposal of a layer of an annealing kernel, in place of `perturbation`. In
            the first layer it replaces a draw of `conditional`; its arguments are then the previous state twice, and scale 1. It is not part of the
            density. None: layers use `conditional` and `perturbation`.
        spaces: the spaces of variables, as pairs of a name and a space. A variable that is not listed is an array of plain numbers.
        memory: number of previous frames whose sampled variables determine `conditional`, such as 2 for a second-order process. None: 1 if nothing is
            carried, otherwise unbounded.
    """

    name: str
    conditional: Callable[[State], Mapping[str, Distribution]]
    perturbation: Callable[[State, Scalar], Mapping[str, Distribution]]
    carry: Callable[[State, State], State] = jax.tree_util.Partial(nothing_carried)
    begin: Callable[[State], State] = jax.tree_util.Partial(nothing_before)
    first: Callable[[State], Mapping[str, Distribution]] | None = None
    derive: Callable[[State], State] = jax.tree_util.Partial(nothing_derived)
    chart: Callable[[State], Any] | None = None
    explore: Callable[[Key, State, State, Scalar], State] | None = None
    spaces: tuple[tuple[str, Space], ...] = ()
    memory: int | None = None

    @property
    def frames_read(self) -> int | None:
        """The number of previous frames that determine `conditional`; None if it is unbounded, as for a filter that is carried along."""
        carries = getattr(self.carry, "func", self.carry) is not nothing_carried
        return 1 if self.memory is None and not carries else self.memory

    def space(self, name: str, shape: tuple[int, ...]) -> Space:
        """Return the space of a variable of this shape."""
        return dict(self.spaces).get(name) or numbered(name, shape)

    def with_derived(self, sampled: State) -> dict[str, Array]:
        """Return the sampled variables, and those that follow from them."""
        return {**sampled, **self.derive(sampled)}

    def state(self, previous: State, sampled: State) -> State:
        """Return the whole state: the sampled variables, those that follow from them, and those that come from the previous state."""
        return self.carry(previous, self.with_derived(sampled))

    def near(self, sampled: State, centre: State) -> dict[str, Array]:
        """Return sampled variables with angles on the circle moved by full turns to within half a turn of a centre: full turns are no distance."""

        def unwrap(name: str, value: Array) -> Array:
            space = self.space(name, value.shape)
            return jnp.asarray(space.coordinates(centre[name], value)).reshape(value.shape) if isinstance(space, Flat) else value

        return {name: unwrap(name, value) for name, value in sampled.items()}

    def sample(self, key: Key, previous: State) -> State:
        """Draw a state of the next frame."""
        return self.state(previous, draw(key, self.conditional(previous)))

    def perturb(self, key: Key, state: State, previous: State, scale: Scalar) -> State:
        """Return the state after a layer of an annealing kernel: by `explore` if there is one, else with noise added."""
        if self.explore is not None:
            return self.state(previous, self.explore(key, state, previous, scale))
        return self.state(previous, draw(key, self.perturbation(state, scale)))

    def enter(self, key: Key, previous: State) -> State:
        """Return a state of the next frame for the first layer of an annealing kernel."""
        if self.explore is not None:
            return self.perturb(key, previous, previous, jnp.ones((), jnp.result_type(*previous.values())))
        return self.sample(key, previous)

    def log_density(self, state: State, previous: State) -> Scalar:
        """Return log p(state | previous), normalised over the support."""
        terms = [jnp.asarray(d.log_prob(state[name])) for name, d in self.conditional(previous).items()]
        return sum(terms, jnp.zeros(()))


def draw(key: Key, distributions: Mapping[str, Distribution]) -> dict[str, Array]:
    """Draw one value of each variable."""
    # Each occurrence of a random generator adds to a program's compile time.
    keys = [key] if len(distributions) == 1 else jax.random.split(key, len(distributions))
    return {name: jnp.asarray(distributions[name].sample(k)) for name, k in zip(sorted(distributions), keys, strict=True)}


class Particles(NamedTuple):
    """Weighted states. Every leaf of `states` has a leading particle axis; the log-weights are normalised."""

    states: State
    log_weights: Float[Array, " particle"]
