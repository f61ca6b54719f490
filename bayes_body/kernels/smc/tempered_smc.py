r"""Tempered SMC within a particle filter, on the extended space of ancestor and state (Del Moral, Doucet & Jasra 2006).

Given the weighted particles $(w_i, s^i_{t-1})$ of the previous frame, inverse temperatures $0 = \beta_0 < \ldots < \beta_K = 1$ lead from the
prediction to the posterior of the frame:

$$\pi_\beta(i, s_t) \propto w_i\, p(s_t \mid s^i_{t-1})\, C(s_t)\, L(s_t; z_t)^\beta, \qquad
\hat p(z_t \mid z_{1:t-1}) = \prod_k \frac{1}{N} \sum_n L(s^n)^{\beta_k - \beta_{k-1}}.$$

Constraints apply at full power in all stages. If the prior has potentials ψ, such as the joints of a loose-limbed body, a first ladder leads from
$\alpha = 0$ to 1 in $\psi^\alpha$, with $\beta = 0$; without it, few independent draws would survive. The evidence is that of the second ladder,
$\log Z(1, 1) - \log Z(1, 0)$. A stage resamples, moves each particle by a Markov kernel that leaves $\pi_\beta$ invariant, and reweights to the next
β. This is the highest β at which the effective sample size is at least the fraction `target_ess` of the particles. A move redraws the ancestor, and
then the state by HMC or a random walk. The state moves in unconstrained coordinates, whitened for each variable by the covariance of the weighted
particles. The step size is adapted from stage to stage by the acceptance rate.

With `prediction = "gaussian"`, the mixture of the particles' transitions is replaced by one Gaussian (density/gaussian_view.py). Then no particle has
an ancestor. The moves by HMC at the posterior itself give slopes, which correct the moments of the particles (smc/moment_correction.py). Independent
runs then agree even about dofs that the images hardly determine (docs/decisions).

The particles are a weighted sample of the posterior. `waste_free` keeps every state of the moves' chains (Dau & Chopin 2022). Temperatures and step
sizes that depend on the particles bias the evidence by O(1/N). With the temperatures and step sizes of a pilot run, `frozen_at`, it is unbiased.
"""

from collections.abc import Callable
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int
from pydantic import Field

from bayes_body.base.errors import input_error
from bayes_body.base.registry import register
from bayes_body.base.shapes import Flag, Key, Keys, Scalar
from bayes_body.base.toml.read import validate
from bayes_body.base.toml.schema import Count, ProperShare, Schema
from bayes_body.density.density import Density
from bayes_body.density.extended import Extended, extended
from bayes_body.density.factor import Particles
from bayes_body.density.gaussian_view import GaussianView, joined
from bayes_body.density.kernel import NO_ANCESTOR, FilterInfo, Kernel
from bayes_body.density.tempering import LogTerms
from bayes_body.kernels.batching import over_particles
from bayes_body.kernels.smc.moment_correction import noise_beside
from bayes_body.kernels.smc.moves import ExtendedParticle, Move, MoveName, MoveSettings, check_gradients, hmc, random_walk, walk, whitening
from bayes_body.kernels.smc.tempering import (
    Ladder,
    TemperedState,
    corrected_positions,
    feynman_kac_step,
    finite_log,
    increment,
    init_state,
    is_at_top,
    potentials_share,
)
from bayes_body.kernels.weights import LogWeights, Resample, Scheme, effective_sample_size, normalise, predict, predict_by_gaussian, resampler

type View = Extended | GaussianView


class Options(Schema):
    """Options of `[kernel] kind = "tempered"`.

    A stage makes `moves` Markov moves. `final_stages` more stages follow at the posterior itself; they keep the particles' weights. With
    `prediction = "particles"`, a move chooses its ancestor among `candidates`, including the current one. With "gaussian" and moves by HMC,
    `correct_moments` moves the particles to moments that are computed from the draws and slopes of all final stages; with `waste_free` it has no
    effect. The last of `most_stages` goes to the posterior, even if few particles survive.
    """

    particles: Count = 1000
    """[particles] per run."""
    move: MoveName = "hmc"
    """`"hmc"`, which needs a likelihood with a gradient, or `"random_walk"`."""
    moves: Count = 2
    """Markov moves per particle and stage; a random walk needs about ten times as many."""
    leapfrog_steps: Count = 5
    """steps of an HMC move; a move takes one more gradient than it has steps."""
    target_ess: ProperShare = 0.5
    """fraction of the particles that is effective after each rise in power; a larger value means more stages."""
    final_stages: Annotated[int, Field(strict=True, ge=0)] = 1
    """stages of moves at the posterior itself."""
    candidates: Count = 8
    """with `prediction = "particles"`, ancestors from which a move chooses, including the current one; with 1 the ancestor never changes."""
    prediction: Literal["particles", "gaussian"] = "particles"
    """what the frame before predicts: `"particles"`, the mixture of its particles' transitions, or `"gaussian"`, one Gaussian with the mean and
    covariance of that mixture, in coordinates without limits."""
    correct_moments: Annotated[bool, Field(strict=True)] = True
    """with a Gaussian prediction, `move = "hmc"` and no `waste_free`: correct the mean and covariance of the particles by the slopes of the
    log-density in all final stages."""
    waste_free: Annotated[bool, Field(strict=True)] = False
    """keep every state of the chains (Dau & Chopin 2022); the number of particles must be a multiple of `moves` + 1."""
    most_stages: Count = 60
    """largest number of stages; the last of them goes to the posterior, even if few effective particles remain."""
    resampling: Scheme = "systematic"
    """how ancestors are drawn: `"systematic"`, `"stratified"`, `"multinomial"` or `"residual"`."""


type LadderKernel = Callable[[Key, Particles, Density], tuple[Particles, FilterInfo, Ladder]]


def build_kernel(frozen_at: Ladder | None = None, **options: Any) -> Kernel:
    """Return a kernel that samples one frame. It returns as many particles as it is given.

    Args:
        frozen_at: the ladder of a pilot run, from `build_ladder_kernel`.
        options: those of `Options`, except `particles`.

    Raises:
        InputError: an argument that does not exist or is outside its range.
    """
    with_ladder = build_ladder_kernel(frozen_at, **options)

    def kernel(key: Key, particles: Particles, density: Density) -> tuple[Particles, FilterInfo]:
        filtered, info, _ = with_ladder(key, particles, density)
        return filtered, info

    return kernel


def build_ladder_kernel(frozen_at: Ladder | None = None, **options: Any) -> LadderKernel:
    """Return a kernel like that of `build_kernel`, which also returns the ladder of temperatures that it used."""
    checked = validate(Options, options, "tempered()")
    return _Sampler(checked, frozen_at).frame


class _Sampler:
    """The stages of a frame, for one choice of options."""

    def __init__(self, options: Options, frozen_at: Ladder | None):
        self.options, self.frozen = options, frozen_at
        self.move: Move = hmc(options.leapfrog_steps) if options.move == "hmc" else random_walk()
        self.resample: Resample = resampler(options.resampling)
        is_corrected = options.prediction == "gaussian" and options.move == "hmc" and not options.waste_free
        self.finals = options.final_stages if is_corrected and options.correct_moments else 0
        self.stages = options.most_stages + options.final_stages if frozen_at is None else frozen_at.inverse_temperatures.shape[0]

    def frame(self, key: Key, particles: Particles, density: Density) -> tuple[Particles, FilterInfo, Ladder]:
        start_key, stages_key, end_key = jax.random.split(key, 3)
        count = particles.log_weights.shape[0]
        if self.options.move == "hmc":
            check_gradients(density, 'move = "hmc"', ', or move = "random_walk"')
        if self.options.waste_free and count % (self.options.moves + 1):
            problem, expected = f"{count} particles with chains of {self.options.moves} moves", f"a multiple of {self.options.moves + 1} particles"
            raise input_error("tempered(waste_free=true)", problem, expected, "change the particles or the moves")
        start, predicted, lost, view = self._begin(start_key, density.with_previous(particles))
        # In the loop, the first step shares the program of the stages. With waste-free moves its shapes differ, so it comes before the loop.
        first = self._step(jax.random.fold_in(stages_key, 0), start, _unmoved, count) if self.options.waste_free else start

        def unfinished(state: TemperedState) -> Array:
            if self.frozen is not None:
                return (state.stage < self.stages) & ~lost
            return (~is_at_top(state.powers) | (state.stages_at_top < self.options.final_stages)) & ~lost

        last = jax.lax.while_loop(unfinished, lambda state: self._stage(jax.random.fold_in(stages_key, state.stage), state, view), first)
        filtered, info = self._result(end_key, view, last, predicted, lost)
        return filtered, info, last.ladder

    # -- stages -------------------------------------------------------------------------------------------------------------------------

    def _begin(self, key: Key, density: Density) -> tuple[TemperedState, Particles, Flag, View]:
        """Return the constrained prediction, the prediction, whether no particle explains the frame, and the view."""
        ancestor_key, draw_key = jax.random.split(key)
        ancestors = self.resample(ancestor_key, density.previous.log_weights)
        if self.options.prediction == "gaussian":
            view, drawn = predict_by_gaussian(draw_key, ancestors, density)
        else:
            view, drawn = extended(density), predict(draw_key, ancestors, density)
        constrained = normalise(drawn.log_constraints).log_weights
        terms = LogTerms(finite_log(drawn.log_likelihoods), finite_log(drawn.log_potentials))
        positions = jax.vmap(view.position)(drawn.states)
        particles = ExtendedParticle(ancestors, positions, terms, jax.tree.map(lambda x: jnp.full_like(x, jnp.nan), positions))
        start = init_state(particles, constrained, self.stages, self.move.step_size, 0.0 if view.density.has_potentials else 1.0, self.finals)
        predicted = Particles(drawn.states, jnp.full_like(constrained, -jnp.log(constrained.shape[0])))
        return start, predicted, drawn.normalised().lost, view

    def _stage(self, key: Key, state: TemperedState, view: View) -> TemperedState:
        """Resample, move at the current temperature, and reweight to the next. Stage 0 only resamples by the constraints and reweights."""
        state, settings = self._with_moves(state)
        states_a_chain = self.options.moves + 1 if self.options.waste_free else 1

        def move(keys: Keys, parents: ExtendedParticle) -> tuple[ExtendedParticle, tuple[Scalar, Scalar]]:
            if not self.options.waste_free:
                return jax.lax.cond(state.stage == 0, _unmoved, lambda keys, parents: self._moved(keys, parents, view, settings), keys, parents)
            chains, (accepted, impossible) = self._moved(keys, parents, view, settings)
            join = jax.tree.map(lambda parent, chain: jnp.concatenate([parent, chain.reshape(-1, *parent.shape[1:])]), parents, chains)
            return join, (accepted, impossible)

        return self._step(key, state, move, state.log_weights.shape[0] // states_a_chain)

    def _step(self, key: Key, state: TemperedState, move: Callable[..., tuple[ExtendedParticle, Any]], resampled: int) -> TemperedState:
        count, stage, at_top = state.log_weights.shape[0], state.stage, is_at_top(state.powers)
        # At β = 1 there is nothing to reweight: the particles keep their weights, unless there are fewer chains than particles.
        keeps_weights = at_top & (resampled == count)

        def resample(key: Key, log_weights: LogWeights, count: int | None = None) -> Int[Array, " drawn"]:
            drawn = self.resample(key, log_weights, count)
            return jnp.where(keeps_weights, jnp.arange(resampled), drawn)

        def log_potential(particles: ExtendedParticle) -> LogWeights:
            step = self._increment(particles.terms, state)
            increments = step.likelihood * particles.terms.likelihood + step.potential * particles.terms.potential
            return jnp.where(keeps_weights, state.log_weights, increments)

        reweighted = feynman_kac_step(key, state.particles, state.log_weights, move, log_potential, resample, resampled)
        step = self._increment(reweighted.particles.terms, state)
        reached = jax.tree.map(jnp.add, state.powers, step)
        # If rounding in float32 left the sum just below 1, that would cost one more stage.
        reached = jax.tree.map(lambda power: jnp.where(power > 1 - 1e-6, 1.0, power), reached)
        acceptance, impossible = (jnp.asarray(rate, state.log_step_size.dtype) for rate in reweighted.info)
        return TemperedState(
            particles=reweighted.particles,
            log_weights=reweighted.log_weights,
            powers=reached,
            stage=stage + 1,
            stages_at_top=state.stages_at_top + at_top,
            log_evidence=state.log_evidence + jnp.where(at_top, 0.0, reweighted.log_increment - potentials_share(step, reweighted.particles.terms)),
            log_step_size=self.move.adapt(state.log_step_size, acceptance),
            ladder=state.ladder.with_powers(stage, reached),
            survival_rates=state.survival_rates.at[stage].set(effective_sample_size(reweighted.log_weights) / count),
            acceptance_rates=state.acceptance_rates.at[stage].set(acceptance),
            impossible=impossible,
            finals=state.finals.with_stage(state.stages_at_top, at_top, reweighted.particles),
        )

    def _increment(self, terms: LogTerms, state: TemperedState) -> LogTerms:
        if self.frozen is not None:
            return self.frozen.increment(state.powers, state.stage)
        return increment(terms, state.powers, self.options.target_ess, state.stage == self.options.most_stages - 1)

    def _moved(self, keys: Keys, parents: ExtendedParticle, view: View, settings: MoveSettings) -> tuple[ExtendedParticle, tuple[Scalar, Scalar]]:
        """Move all particles. Return them with the mean acceptance rate and the share of impossible proposals."""
        chains, *rates = self._walk(keys, parents, view, settings)
        accepted, impossible = map(jnp.mean, rates)
        return chains, (accepted, impossible)

    # -- moves --------------------------------------------------------------------------------------------------------------------------

    def _with_moves(self, state: TemperedState) -> tuple[TemperedState, MoveSettings]:
        """Enter the step size and whitening of the moves at the current temperature in the ladder. Return the state and the settings of the moves."""
        # What stage 0 enters here is replaced by stage 1.
        reached = jnp.maximum(state.stage - 1, 0)
        if self.frozen is not None:
            roots = {name: root[reached] for name, root in self.frozen.whitening.items()}
            log_step_size = self.frozen.log_step_sizes[reached]
        else:
            roots = {name: whitening(position, state.log_weights) for name, position in state.particles.position.items()}
            log_step_size = state.log_step_size
        ladder = state.ladder.with_moves(reached, log_step_size, roots)
        return state._replace(ladder=ladder), MoveSettings(state.powers, jnp.exp(log_step_size), roots)

    def _walk(
        self, keys: Keys, particles: ExtendedParticle, view: View, settings: MoveSettings
    ) -> tuple[ExtendedParticle, Float[Array, " particle"], Float[Array, " particle"]]:
        """Move all particles.

        Return their last states, or with `waste_free` all states (particle, move, ...), their acceptance rates, and their shares of impossible
        proposals.
        """
        options = self.options

        def move_particle(particle: tuple[Key, ExtendedParticle], shared: tuple[View, MoveSettings]) -> tuple[ExtendedParticle, Scalar, Scalar]:
            chain, accepted, impossible = walk(*particle, *shared, self.move, options.moves, options.candidates)
            moved = chain if options.waste_free else jax.tree.map(lambda leaf: leaf[-1], chain)
            return moved._replace(terms=jax.tree.map(finite_log, moved.terms)), accepted, impossible

        return over_particles(move_particle, (keys, particles), (view, settings))

    # -- results ------------------------------------------------------------------------------------------------------------------------

    def _result(self, key: Key, view: View, last: TemperedState, predicted: Particles, lost: Flag) -> tuple[Particles, FilterInfo]:
        ancestors, positions = last.particles.ancestor, corrected_positions(last)
        if isinstance(view, GaussianView):
            noise = noise_beside(key, jax.vmap(joined)(positions), last.log_weights, view.unread_size)
            states, ancestors = jax.vmap(view.completed)(noise, ancestors, positions), jnp.full_like(ancestors, NO_ANCESTOR)
        else:
            states = jax.vmap(view.state)(ancestors, positions)
        posterior = Particles(states, normalise(last.log_weights).log_weights)
        particles = jax.tree.map(lambda prediction, filtered: jnp.where(lost, prediction, filtered), predicted, posterior)
        info = FilterInfo(
            ancestors=ancestors,
            ess=effective_sample_size(particles.log_weights),
            survival_rate=last.survival_rates,
            inverse_temperatures=last.ladder.inverse_temperatures,
            log_evidence=jnp.where(lost, -jnp.inf, last.log_evidence),
            lost=lost,
            acceptance_rate=last.acceptance_rates,
            evaluations=self._evaluations(last),
        )
        return particles, info

    def _evaluations(self, last: TemperedState) -> Array:
        """Return the number of evaluations in the prediction and in the moves of all stages."""
        count, options = last.log_weights.shape[0], self.options
        moved = count // (options.moves + 1) if options.waste_free else count
        return count + (last.stage - 1) * moved * options.moves * self.move.evaluations


def _unmoved(keys: Keys, parents: ExtendedParticle) -> tuple[ExtendedParticle, tuple[Scalar, Scalar]]:
    """Move nothing, as in stage 0: no move has been accepted or refused."""
    dtype = parents.terms.likelihood.dtype
    return parents, (jnp.full((), jnp.nan, dtype), jnp.zeros((), dtype))


def _markov_move(options: Options) -> Any:
    # The move is built from this kernel's parts, so it is imported only when needed.
    from bayes_body.kernels.markov_moves import move_of_tempered

    return move_of_tempered(options)


@register(
    "kernel", "tempered", Options, samples_posterior=True, markov_move=_markov_move, by_particles=lambda options: options.prediction == "particles"
)
def build(options: Options, **_: Any) -> Kernel:
    """Build the kernel from a definition's options."""
    return build_kernel(**options.model_dump(exclude={"particles"}))
