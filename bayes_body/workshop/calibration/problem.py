"""A calibration problem: a motion prior, factors, a first state, and the figures of a state that are ranked. Cases are drawn from it.

A case is a truth and its simulated data. The truth is a path from the motion prior, which the constraints accept or reject as a whole. The
likelihoods simulate the data of each frame. This is a draw from the model's joint distribution, constraints included.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.base.errors import input_error
from bayes_body.base.shapes import Flag, Index, Key, Scalar
from bayes_body.density.density import Density
from bayes_body.density.factor import Factor, Particles, State, Transition, draw, variables
from bayes_body.model.body.kinematics import marker_positions
from bayes_body.model.body.placed_body import require
from bayes_body.model.body.placement import POSE
from bayes_body.model.body.solids import Body
from bayes_body.model.build import Model
from bayes_body.model.unknowns.apply import with_changes
from bayes_body.model.unknowns.unknown import Unknown, prior_draws

# Number of rejected paths after which a case is given up.
MOST_PATHS = 1000
AXES = ("x", "y", "z")
ROUNDING = 1e-5


@partial(jax.tree_util.register_dataclass, meta_fields=["names"], data_fields=["compute"])
@dataclass(frozen=True)
class Quantities:
    """Figures of a state, with their names. `compute` is a `jax.tree_util.Partial`, so its arrays are leaves."""

    names: tuple[str, ...]
    compute: Callable[[State], Float[Array, " quantity"]]


@partial(jax.tree_util.register_dataclass, meta_fields=["wandering"], data_fields=["transition", "factors", "first", "quantities", "unknowns"])
@dataclass(frozen=True, eq=False)
class Problem:
    """A model for the harness. It is a pytree, so a compiled program takes its arrays as arguments instead of constants.

    Attributes:
        transition: the motion prior.
        factors: everything else; each likelihood offers `simulate`.
        first: the state from which a case's first state is drawn by `wandering` steps.
        quantities: the figures to rank; the log-likelihood is added to them.
        wandering: steps of the motion prior from `first` to a case's first state. The filter knows that state, so its distribution does not matter.
        unknowns: the variables of a case's first state that the filter does not know: they are drawn from their prior.
    """

    transition: Transition
    factors: tuple[Factor, ...]
    first: State
    quantities: Quantities
    wandering: int = 10
    unknowns: tuple[Unknown, ...] = ()

    def density(self, data: Any, previous: Particles) -> Density:
        """The posterior of a frame."""
        return Density(self.transition, self.factors, data, previous)

    def start(self, key: Key, first: State, count: int) -> Particles:
        """The particles before the first frame: all at the first state, but for the unknowns, which have their prior."""
        particles = point_mass(first, count)
        if not self.unknowns:
            return particles
        drawn = prior_draws(key, self.unknowns, count)
        return particles._replace(states={**particles.states, **{name: values.astype(first[name].dtype) for name, values in drawn.items()}})


class Case(NamedTuple):
    """A truth and its data, with a leading frame axis; the filter knows `first`.

    `refused` is set if no path was accepted; `unbounded` if a log-constraint was above 0, so that rejection is not exact.
    """

    first: State
    path: State
    data: Any
    refused: Flag
    unbounded: Flag


def problem_of(model: Model, wandering: int = 10) -> Problem:
    """The problem of a model: the dofs, the coordinates of the markers of the body as the state has it, and the unknowns are ranked.

    Raises:
        InputError: the body is placed by its parts.
    """
    require(model.body, POSE, "a calibration of joint angles", "a model of a body that is placed by angles")
    names = (*model.body.dof_names, *(f"{marker} {axis}" for marker in model.body.markers.names for axis in AXES))
    names += tuple(f"{term.name} {label}" for term in model.unknowns for label in term.space.labels)
    of_body = tuple(term for term in model.unknowns if term.name in model.placing)
    quantities = jax.tree_util.Partial(_pose_and_markers, model.body, of_body, model.unknowns)
    return Problem(model.transition, model.factors, model.initial, Quantities(names, quantities), wandering, model.unknowns)


def _pose_and_markers(body: Body, of_body: tuple[Unknown, ...], unknowns: tuple[Unknown, ...], state: State) -> Float[Array, " quantity"]:
    body = with_changes(of_body, body, variables(state))
    markers = marker_positions(body.skeleton, body.markers, state["pose"])
    return jnp.concatenate([state["pose"], markers.reshape(-1), *(state[term.name] for term in unknowns)])


def point_mass(state: State, count: int = 1) -> Particles:
    """`count` equally weighted particles with the same state."""
    states = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, *jnp.shape(leaf))), dict(state))
    dtype = jax.tree.leaves(states)[0].dtype
    return Particles(states, jnp.full((count,), -np.log(count), dtype))


class Path(NamedTuple):
    """A path of the motion prior that the constraints accept: its start, its states, and the state before each (leading frame axis)."""

    start: Index
    states: State
    parents: State
    refused: Flag
    unbounded: Flag


def draw_case(key: Key, problem: Problem, frames: int) -> Case:
    """A truth over `frames` frames, and its data."""
    first_key, path_key, data_key = jax.random.split(key, 3)
    wandered = draw_path(first_key, problem, point_mass(problem.first), problem.wandering) if problem.wandering else None
    first = problem.first if wandered is None else jax.tree.map(lambda leaf: leaf[-1], wandered.states)
    # Folded in, so that the cases of a problem without unknowns are as they were.
    prior_key = jax.random.fold_in(key, 1)
    first = {**first, **draw(prior_key, {term.name: term.prior() for term in problem.unknowns})} if problem.unknowns else first
    path = draw_path(path_key, problem, point_mass(first), frames)
    data = draw_data(data_key, problem, path)
    flags = [(trajectory.refused, trajectory.unbounded) for trajectory in (path, wandered) if trajectory is not None]
    refused, unbounded = (jnp.any(jnp.stack(column)) for column in zip(*flags, strict=True))
    return Case(first, path.states, data, refused, unbounded)


def draw_data(key: Key, problem: Problem, path: Path) -> Any:
    """Simulate the data of each state of a path."""

    def simulate(frame_key: Key, state: State, previous: State) -> Any:
        return problem.density({}, point_mass(previous)).simulate(frame_key, state, previous)

    return jax.vmap(simulate)(jax.random.split(key, jax.tree.leaves(path.states)[0].shape[0]), path.states, path.parents)


def draw_path(key: Key, problem: Problem, previous: Particles, frames: int) -> Path:
    """Draw a path that starts at one of `previous`, by weight. Redraw it, including the start, until the constraints accept it."""

    def redraw(tried: tuple[Index, Path]) -> tuple[Index, Path]:
        return tried[0] + 1, _attempt(jax.random.fold_in(key, tried[0] + 1), problem, previous, frames)

    start = jnp.zeros((), jnp.int32)
    first = _attempt(jax.random.fold_in(key, start), problem, previous, frames)
    if all(factor.side == "likelihood" for factor in problem.factors):
        return first
    return jax.lax.while_loop(lambda t: t[1].refused & ~t[1].unbounded & (t[0] < MOST_PATHS), redraw, (start, first))[1]


def _attempt(key: Key, problem: Problem, previous: Particles, frames: int) -> Path:
    start_key, path_key, accept_key = jax.random.split(key, 3)
    start = jax.random.categorical(start_key, previous.log_weights).astype(jnp.int32)
    density = problem.density({}, previous)

    def step(previous_state: State, step_key: Key) -> tuple[State, tuple[State, State, Scalar]]:
        state = dict(problem.transition.sample(step_key, previous_state))
        return state, (state, previous_state, density.log_constraint(state, previous_state) + density.log_potential(state, previous_state))

    first = jax.tree.map(lambda leaf: leaf[start], dict(previous.states))
    _, (states, parents, constraints) = jax.lax.scan(step, first, jax.random.split(path_key, frames))
    level = jnp.log(jax.random.uniform(accept_key, (), minval=jnp.finfo(constraints.dtype).tiny))
    # Log-constraints are rounded sums, so a value slightly above 0 counts as 0.
    return Path(start, states, parents, level >= jnp.sum(constraints), jnp.any(constraints > ROUNDING))


def check_cases(refused: Any, unbounded: Any) -> None:
    """Refuse cases that cannot be simulated exactly.

    Raises:
        InputError: a log-constraint above 0, or constraints that reject nearly every path.
    """
    if np.any(unbounded):
        problem, expected = "a constraint's log-potential is above 0", "constraints of at most 0, so that a path is accepted with their exponential"
        raise input_error("the model", problem, expected, "subtract its maximum, or check the model without it")
    if np.any(refused):
        problem = f"{MOST_PATHS} paths of the motion prior were all rejected by the constraints"
        raise input_error("the model", problem, "constraints that accept some of them", "start from another first pose, or check fewer frames")
