r"""The hybrid Monte Carlo filter (Poon & Fleet 2002, 4), through blackjax, on the marginal view.

Given the particles $(w_i, s^i_{t-1})$ of the previous frame, the target is the likelihood times the prediction mixture (14),
$p(s_t \mid z_{1:t}) \propto L(s_t; z_t) \sum_i w_i\, p(s_t \mid s^i_{t-1})$, in unconstrained coordinates.

A frame begins with M states (`kernels/hmc/starts.py`). They are chosen by sampling importance resampling from `starts` draws of the mixture (M
draws in the paper). These draws also estimate the evidence, as accurately as a particle filter of that size. Alternatively, the states are M
particles of an annealed filter. A chain runs from each state, and its first states are burn-in. The remaining states of all chains are the particles.
They have equal weight and are ordered by chain.

If a likelihood reads the previous frame, like image motion, the sum over ancestors would cost one evaluation of the images for each. Then the chains
run on the *extended* view: each has an ancestor, which a Gibbs step redraws among `candidates` before each trajectory.

With `prediction = "gaussian"`, the mixture is replaced by one Gaussian (kernels/hmc/gaussian.py).

`carry` chooses the components of the next frame's mixture. They are either the means of the chains, as in the paper, one component per chain, or the
draws themselves, each with an ancestor drawn from $p(i \mid s_t)$. Means keep only the spread between chains, not that of the posterior. A filter
with one chain treats the previous frame as known exactly.
"""

from collections.abc import Callable
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int
from pydantic import Field, model_validator

from bayes_body.base.registry import register
from bayes_body.base.shapes import Flag, Index, Key, Scalar
from bayes_body.base.toml.read import validate
from bayes_body.base.toml.schema import Count, Positive, Schema, Share
from bayes_body.density.density import Density, Unconstrained
from bayes_body.density.factor import Particles, State, Transition
from bayes_body.density.gaussian_view import GaussianView
from bayes_body.density.kernel import NO_ANCESTOR, FilterInfo, Kernel
from bayes_body.density.spaces import Flat
from bayes_body.kernels.batching import axes_of, over_particles
from bayes_body.kernels.hmc.adaptation import FEWEST
from bayes_body.kernels.hmc.gaussian import NOISE, gaussian_mass, gaussian_starts, gaussian_states, gaussian_target
from bayes_body.kernels.hmc.hamiltonian import Chain, Sampler, Schedule, chain_figures, effective_draws, run_chain
from bayes_body.kernels.hmc.mass import correlated, inverse_mass
from bayes_body.kernels.hmc.starts import (
    Initialisation,
    Start,
    StartsBy,
    by_annealing,
    by_importance,
    by_tempering,
    compares_frames,
    whole_states,
    with_ancestor,
)
from bayes_body.kernels.smc.moves import check_gradients
from bayes_body.kernels.weights import Scheme, resampler

type Carry = Literal["means", "draws"]
type Mass = Literal["curvature", "curvature_matrix", "particles", "adapted"]
# The axis along which chains adapt together.
CHAINS = "chain"


class Options(Schema):
    """Options of `[kernel] kind = "hmc"`.

    `particles` is the number of draws of all `chains` together: every `thinning`-th state after `burn_in`. `step` is the paper's factor of the step
    size. `jitter` is the fraction by which a trajectory's number of steps varies. With a `target_acceptance`, burn-in tunes the step. With
    `mass = "adapted"`, burn-in estimates the mass matrix, beginning with that of the curvature, and all chains adapt together. The starts of the
    chains are chosen among `starts` draws of the prediction, by weight (`starts_by = "importance"`), by annealing, or among as many particles of
    `tempered` (`"tempering"`); always the last if the prior has potentials, like the joints of a loose-limbed body. `candidates` is the number of
    ancestors among which a chain redraws its own, if a likelihood reads the previous frame.
    """

    particles: Count = 400
    """[draws] kept per frame, all chains together."""
    chains: Count = 4
    """each with its own start."""
    burn_in: Annotated[int, Field(strict=True, ge=0)] = 50
    """first states of a chain, which are discarded."""
    thinning: Count = 1
    """states of a chain per kept draw."""
    leapfrog_steps: Count = 20
    """steps of a trajectory; each takes one gradient."""
    step: Positive = 0.2
    """step size, as a factor of the step that follows from the curvature at the chain's start."""
    jitter: Share = 0.2
    """fraction by which the number of steps of a trajectory varies."""
    sampler: Sampler = "hmc"
    """`"hmc"`, or `"nuts"`, which chooses the length of trajectories itself."""
    target_acceptance: Annotated[float, Field(strict=True, ge=0, lt=1)] = 0.0
    """acceptance rate to which burn-in tunes the step; with `"adapted"`, all chains have the same step; with 0 the step is not tuned."""
    mass: Mass = "curvature"
    """mass matrix, from the curvature at the start: its diagonal (`"curvature"`), the whole matrix (`"curvature_matrix"`), its diagonal with the
    correlations of the previous frame (`"particles"`), or first the whole matrix and then a matrix learned in burn-in (`"adapted"`)."""
    starts_by: StartsBy = "importance"
    """how the starts are chosen: by weight (`"importance"`), by five layers of an annealed filter, which keeps more modes (`"annealing"`), or among
    particles of `tempered`, which weights modes by their probability and estimates the evidence better (`"tempering"`)."""
    starts: Annotated[int, Field(strict=True, ge=0)] = 100
    """[draws] from the prediction; the chains' starts are chosen among them; at least as many as chains."""
    prediction: Literal["particles", "gaussian"] = "particles"
    """what the frame before predicts: `"particles"`, the mixture about what it carries on, or `"gaussian"`, one Gaussian with the mean and covariance
    of that mixture. Take the latter for a model with `[[unknown]]`."""
    carry: Carry = "draws"
    """what the next frame starts from: the `"draws"`, or the `"means"` of the chains, as in the paper."""
    candidates: Count = 8
    """if a likelihood reads the frame before, as `image_motion` does: ancestors among which a chain redraws its own before each trajectory."""
    resampling: Scheme = "systematic"
    """how ancestors are drawn: `"systematic"`, `"stratified"`, `"multinomial"` or `"residual"`."""

    @model_validator(mode="after")
    def _check_chains(self) -> "Options":
        if self.target_acceptance and not self.burn_in:
            raise ValueError("target_acceptance without burn_in: the step is tuned in burn-in; give a burn_in, such as 50")
        if self.mass == "adapted" and self.burn_in < FEWEST:
            raise ValueError(f"burn_in = {self.burn_in} is too short to estimate the mass matrix; give at least {FEWEST}, such as 24")
        if self.prediction == "gaussian" and (self.carry, self.starts_by) != ("draws", "importance"):
            raise ValueError('prediction = "gaussian" needs carry = "draws" and starts_by = "importance"; leave them out')
        return self


def build_sampler(**options: Any) -> Callable[[Key, Density, int], tuple[Particles, FilterInfo]]:
    """Return a function (key, density, number of draws) -> draws of one frame's posterior, given the previous frame's particles in the density.

    Args:
        options: as for `build_kernel`; `carry` is not used.

    Raises:
        InputError: an argument that does not exist or is outside its range.
    """
    return _Filter(validate(Options, options, "hmc()")).sample


def build_kernel(**options: Any) -> Kernel:
    """Return a kernel that filters one frame. It returns as many particles as it is given.

    Args:
        options: those of `Options`, except `particles`.

    Raises:
        InputError: an argument that does not exist or is outside its range.
    """
    return _Filter(validate(Options, options, "hmc()")).frame


class _Filter:
    """The computations of a frame, for one choice of options."""

    def __init__(self, options: Options):
        self.options = options
        self.resample = resampler(options.resampling)

    def frame(self, key: Key, particles: Particles, density: Density) -> tuple[Particles, FilterInfo]:
        count = particles.log_weights.shape[0]
        if self.options.carry == "draws":
            return self.sample(key, density.with_previous(particles), count)
        length = self._length(count)
        filtered, info = self.sample(key, density.with_previous(_chain_means(particles, length, density.transition)), count)
        # The first draw of a chain represents its mean.
        return filtered, info._replace(ancestors=info.ancestors * length)

    def _length(self, count: int) -> int:
        """Return the number of draws per chain: ceil(count / chains). Surplus draws of the last chain are discarded."""
        return -(-count // min(self.options.chains, count))

    def sample(self, key: Key, density: Density, count: int) -> tuple[Particles, FilterInfo]:
        """Return `count` draws of a frame's posterior. The previous frame's particles in the density define the prediction mixture."""
        check_gradients(density, "the kernel 'hmc'")
        if self.options.prediction == "gaussian":
            return self._sample_gaussian(key, density, count)
        start_key, chain_key, ancestor_key = jax.random.split(key, 3)
        length = self._length(count)
        chains = -(-count // length)
        # Computed once, since its predictions are the same for all chains and draws.
        target = density.unconstrained()
        begin = self._initialise(start_key, target, chains)
        keys = jax.random.split(chain_key, chains)
        batch = -(-chains // jax.device_count())
        # If each chain has its own mass matrix, each needs its own step.
        chain_axes = axes_of(chains, batch, CHAINS) if self.options.mass == "adapted" else ()
        # JAX cannot check which values differ between devices in the loop of NUTS or in a sum over chains.
        checked = self.options.sampler != "nuts" and not chain_axes
        ran: Chain = over_particles(self._chain(length, chain_axes), (keys, begin.starts), target, batch, checked, CHAINS)
        draws, ancestors = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:count], (ran.positions, ran.ancestors))
        states, ancestors = self._states(ancestor_key, draws, target) if ancestors is None else (whole_states(draws, ancestors, target), ancestors)
        by_dof = effective_draws(_reported(target, ran.positions))
        return self._result(states, ancestors, ran, by_dof, length, begin.log_evidence, begin.lost, begin.evaluations)

    def _sample_gaussian(self, key: Key, density: Density, count: int) -> tuple[Particles, FilterInfo]:
        """Return draws of the posterior whose prediction is one Gaussian; they have no ancestors."""
        start_key, chain_key, state_key = jax.random.split(key, 3)
        length = self._length(count)
        chains = -(-count // length)
        begin = gaussian_starts(start_key, density, max(self.options.starts, chains), chains, self.resample)
        batch = -(-chains // jax.device_count())
        chain_axes = axes_of(chains, batch, CHAINS) if self.options.mass == "adapted" else ()
        checked = self.options.sampler != "nuts" and not chain_axes

        def run(key_and_start: tuple[Key, State], view: GaussianView) -> Chain:
            mass = gaussian_mass(view, key_and_start[1], self.options.mass != "curvature")
            step = jnp.asarray(self.options.step, mass.dtype)
            return run_chain(*key_and_start, gaussian_target(view), step, mass, self._schedule(length), chain_axes)

        ran: Chain = over_particles(run, (jax.random.split(chain_key, chains), begin.positions), begin.view, batch, checked, CHAINS)
        noise = ran.positions[NOISE]
        drawn = gaussian_states(state_key, noise.reshape(-1, noise.shape[-1]), begin.view)
        positions = jax.vmap(lambda state: ravel_pytree(begin.view.coordinates.unconstrain(state))[0])(drawn)
        by_dof = effective_draws(positions.reshape(chains, length, -1))
        states = jax.tree.map(lambda leaf: leaf[:count], dict(drawn))
        ancestors = jnp.full((count,), NO_ANCESTOR, jnp.int32)
        evaluations = max(self.options.starts, chains) + 2 * chains * noise.shape[-1]
        return self._result(states, ancestors, ran, by_dof, length, begin.log_evidence, begin.lost, evaluations)

    def _result(
        self,
        states: State,
        ancestors: Int[Array, " particle"],
        ran: Chain,
        by_dof: Float[Array, " entry"],
        length: int,
        log_evidence: Scalar,
        lost: Flag,
        evaluations: Any,
    ) -> tuple[Particles, FilterInfo]:
        """Return the draws of chains of a length, and what they say of themselves. `evaluations` are those before the chains."""
        ess, count = jnp.min(by_dof), ancestors.shape[0]
        info = FilterInfo(
            ancestors=ancestors,
            ess=ess,
            survival_rate=(ess / count)[None],
            inverse_temperatures=jnp.ones((1,), ess.dtype),
            log_evidence=log_evidence,
            lost=lost,
            acceptance_rate=jnp.mean(ran.acceptance)[None],
            evaluations=evaluations + jnp.sum(ran.gradients),
            markov=chain_figures(ran) | {"ess": by_dof, "length": jnp.asarray(length, jnp.int32)},
        )
        return Particles(states, jnp.full((count,), -jnp.log(count), ess.dtype)), info

    def _initialise(self, key: Key, target: Unconstrained, chains: int) -> Initialisation:
        by = "tempering" if target.density.has_potentials else self.options.starts_by
        initialise = {"importance": by_importance, "annealing": by_annealing, "tempering": by_tempering}[by]
        return initialise(key, target, max(self.options.starts, chains), chains, self.resample)

    def _schedule(self, length: int) -> Schedule:
        options = self.options
        return Schedule(
            draws=length,
            burn_in=options.burn_in,
            thinning=options.thinning,
            leapfrog_steps=options.leapfrog_steps,
            jitter=options.jitter,
            sampler=options.sampler,
            target_acceptance=options.target_acceptance,
            adapts_mass=options.mass == "adapted",
        )

    def _chain(self, length: int, axes: tuple[str, ...]) -> Callable[[tuple[Key, Start], Unconstrained], Chain]:
        options, schedule = self.options, self._schedule(length)

        def run(key_and_start: tuple[Key, Start], target: Unconstrained) -> Chain:
            key, start = key_and_start
            is_dense = options.mass in ("curvature_matrix", "adapted")
            mass = inverse_mass(target, start.position, target.density.ancestor(start.ancestor), is_dense)
            if options.mass == "particles":
                mass = correlated(mass, *_coordinates(target))
            view = with_ancestor(start, target.density, options.candidates) if compares_frames(target.density) else target
            return run_chain(key, start.position, view, jnp.asarray(options.step, mass.dtype), mass, schedule, axes)

        return run

    def _states(self, key: Key, draws: State, target: Unconstrained) -> tuple[State, Int[Array, " particle"]]:
        """Return the whole states of draws, each with an ancestor drawn from p(i | s)."""

        def complete(key_and_position: tuple[Key, State], target: Unconstrained) -> tuple[State, Index]:
            return target.complete(*key_and_position)

        keys = jax.random.split(key, jax.tree.leaves(draws)[0].shape[0])
        return over_particles(complete, (keys, draws), target)


def _reported(target: Unconstrained, positions: State) -> Float[Array, "chain draw entry"]:
    """Return the values whose effective draws are reported: the derived variables if there are any, else the coordinates."""
    transition, (chains, length) = target.density.transition, jax.tree.leaves(dict(positions))[0].shape[:2]
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), dict(positions))
    derived = jax.vmap(lambda position: transition.derive(target.coordinates.constrain(position)))(flat)
    values = _on_one_turn(dict(derived) or flat, jnp.full((chains * length,), 1 / (chains * length)), transition)
    return jax.vmap(lambda draw: ravel_pytree(draw)[0])(values).reshape(chains, length, -1)


def _on_one_turn(states: State, weights: Float[Array, " particle"], transition: Transition) -> dict[str, Array]:
    """Return the states, or their unconstrained coordinates, with their angles on the circle within half a turn of the mean.

    Otherwise, full turns between draws would count as spread. Angles on the circle are their own unconstrained coordinates.
    """

    def unwound(name: str, leaf: Array) -> Array:
        space = transition.space(name, leaf.shape[1:])
        if not isinstance(space, Flat):
            return leaf
        return jnp.asarray(space.coordinates(space.mean(weights, leaf), leaf)).reshape(leaf.shape)

    return {name: unwound(name, leaf) for name, leaf in states.items()}


def _chain_means(particles: Particles, length: int, transition: Transition) -> Particles:
    """Return the mean state of each chain of `length` draws, with equal weights, by the intrinsic mean of each variable's space.

    Derived variables are computed from the means: the mean of derived poses need not be the pose of any state.
    """
    count = particles.log_weights.shape[0]
    chains = -(-count // length)
    # All means are computed at once. One after the other, each would add to the program. The last chain may be shorter.
    place = np.arange(chains * length).reshape(chains, length)
    is_draw = place < count
    weights = is_draw / is_draw.sum(axis=1, keepdims=True)

    def means(name: str, draws: Array) -> Array:
        space = transition.space(name, draws.shape[1:])
        return jax.vmap(lambda shares, values: jnp.asarray(space.mean(shares, values)))(
            jnp.asarray(weights, draws.dtype), draws[np.minimum(place, count - 1)]
        )

    states = {name: means(name, leaf) for name, leaf in particles.states.items()}
    states |= jax.vmap(transition.derive)(states)
    return Particles(states, jnp.full((chains,), -jnp.log(chains), particles.log_weights.dtype))


def _coordinates(target: Unconstrained) -> tuple[Float[Array, "particle dof"], Float[Array, " particle"]]:
    """Return the particles of the previous frame in unconstrained coordinates, and their weights."""
    previous = target.density.previous
    weights = jax.nn.softmax(previous.log_weights)
    states = _on_one_turn(previous.states, weights, target.density.transition)
    return jax.vmap(lambda state: ravel_pytree(target.unconstrain(state))[0])(states), weights


def _markov_move(options: Options) -> Any:
    # The move is built from this kernel's parts, so it is imported only when needed.
    from bayes_body.kernels.markov_moves import move_of_hmc

    return move_of_hmc(options)


@register("kernel", "hmc", Options, samples_posterior=True, markov_move=_markov_move, by_particles=lambda options: options.prediction == "particles")
def build(options: Options, **_: Any) -> Kernel:
    """Build the kernel from a definition's options."""
    return _Filter(options).frame
