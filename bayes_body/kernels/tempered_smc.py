r"""Tempered SMC within a particle filter, on the extended space of ancestor and state (Del Moral, Doucet & Jasra 2006).

With the weighted particles $(w_i, s^i_{t-1})$ of the frame before, inverse temperatures $0 = \beta_0 < \ldots < \beta_K = 1$ lead from the
prediction to the posterior of the frame:

$$\pi_\beta(i, s_t) \propto w_i\, p(s_t \mid s^i_{t-1})\, C(s_t)\, L(s_t; z_t)^\beta, \qquad
\hat p(z_t \mid z_{1:t-1}) = \prod_k \frac{1}{N} \sum_n L(s^n)^{\beta_k - \beta_{k-1}}.$$

Only the likelihood is tempered, a constraint holds at full power throughout. A stage resamples, moves each particle by a Markov kernel that keeps
$\pi_\beta$, and reweights to the next temperature: the highest that leaves an effective share `target_ess` of the particles. A move redraws the
ancestor, then the state by HMC or a random walk, in coordinates without limits, whitened variable by variable by the covariance of the weighted
particles; the size of a step follows the acceptance rate from stage to stage.

The particles are a weighted sample of the posterior. `waste_free` keeps every state of the chains that the moves make (Dau & Chopin 2022).
Temperatures and steps that are chosen by the particles bias the evidence by O(1/N); with those of a pilot run, `frozen_at`, it is unbiased.
"""

from collections.abc import Callable
from typing import Annotated, Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int
from pydantic import Field

from bayes_body.density.factor import FilterInfo, FrameDensity, Kernel, Particles, State
from bayes_body.errors import input_error
from bayes_body.kernels.parts.batching import over_particles
from bayes_body.kernels.parts.extended import Extended, Frame, Moving, make_frame, predict, state_of, walk, whitening
from bayes_body.kernels.parts.feynman_kac import LOG_ZERO, feynman_kac_step, next_increment
from bayes_body.kernels.parts.moves import Move, MoveName, check_gradients, hmc, random_walk
from bayes_body.kernels.parts.resampling import Resample, Scheme, resampler
from bayes_body.kernels.parts.tempered_state import Ladder, TemperedState, init_state
from bayes_body.kernels.parts.weights import LogWeights, effective_sample_size, normalise
from bayes_body.registry import register
from bayes_body.shapes import Index, Key, Keys, Scalar
from bayes_body.toml.read import validate
from bayes_body.toml.schema import Count, ProperShare, Schema

# How strongly the logarithm of the step follows the acceptance rate of a stage.
GAIN = 1.0


class Options(Schema):
    """Options of `[kernel] kind = "tempered"`.

    `moves` Markov moves a stage; `final_stages` more stages at the posterior itself, which keep the particles' weights; `candidates` ancestors among
    which a move chooses, the present one included; the last of `most_stages` goes to the posterior, however few particles that leaves.
    """

    particles: Count = 1000
    move: MoveName = "hmc"
    moves: Count = 2
    leapfrog_steps: Count = 5
    target_ess: ProperShare = 0.5
    final_stages: Annotated[int, Field(strict=True, ge=0)] = 1
    candidates: Count = 8
    waste_free: Annotated[bool, Field(strict=True)] = False
    most_stages: Count = 60
    resampling: Scheme = "systematic"


type Climber = Callable[[Key, Particles, FrameDensity], tuple[Particles, FilterInfo, Ladder]]


def build_kernel(frozen_at: Ladder | None = None, **options: Any) -> Kernel:
    """One frame of the sampler; the number of particles is that of the particles given to it.

    Args:
        frozen_at: the ladder of a pilot run, from `build_climber`.
        options: those of `Options`, but for the particles.

    Raises:
        InputError: an argument that does not exist or is outside its range.
    """
    climb = build_climber(frozen_at, **options)

    def kernel(key: Key, particles: Particles, density: FrameDensity) -> tuple[Particles, FilterInfo]:
        after, info, _ = climb(key, particles, density)
        return after, info

    return kernel


def build_climber(frozen_at: Ladder | None = None, **options: Any) -> Climber:
    """As `build_kernel`; what it builds also gives the ladder that it climbed."""
    checked = validate(Options, options, "tempered()")
    return _Sampler(checked, frozen_at).climb


class _Sampler:
    """The stages of a frame, for one choice of options."""

    def __init__(self, options: Options, frozen_at: Ladder | None):
        self.options, self.frozen = options, frozen_at
        self.move: Move = hmc(options.leapfrog_steps) if options.move == "hmc" else random_walk()
        self.resample: Resample = resampler(options.resampling)
        self.stages = options.most_stages + options.final_stages if frozen_at is None else frozen_at.inverse_temperatures.shape[0]

    def climb(self, key: Key, particles: Particles, density: FrameDensity) -> tuple[Particles, FilterInfo, Ladder]:
        start_key, stages_key = jax.random.split(key)
        count = particles.log_weights.shape[0]
        if self.options.move == "hmc":
            check_gradients(density, 'move = "hmc"', ', or move = "random_walk"')
        if self.options.waste_free and count % (self.options.moves + 1):
            found, expected = f"{count} particles with chains of {self.options.moves} moves", f"a multiple of {self.options.moves + 1} particles"
            raise input_error("tempered(waste_free=true)", found, expected, "change the particles or the moves")
        frame = make_frame(density, particles)
        first, predicted, lost = self._begin(start_key, frame)

        def unfinished(climb: TemperedState) -> Array:
            if self.frozen is not None:
                return (climb.stage < self.stages) & ~lost
            return ((climb.beta < 1) | (climb.stages_at_top < self.options.final_stages)) & ~lost

        top = jax.lax.while_loop(unfinished, lambda climb: self._stage(jax.random.fold_in(stages_key, climb.stage), climb, frame), first)
        after, info = self._result(frame, top, predicted, lost)
        return after, info, top.ladder

    # -- stages -------------------------------------------------------------------------------------------------------------------------

    def _begin(self, key: Key, frame: Frame) -> tuple[TemperedState, Particles, Array]:
        """The prediction under its constraints, reweighted to the first temperature; the prediction alone; and whether it explains nothing."""
        ancestor_key, draw_key, resample_key = jax.random.split(key, 3)
        ancestors = self.resample(ancestor_key, frame.previous.log_weights)
        keys = jax.random.split(draw_key, ancestors.shape[0])
        particles, states, log_constraints = over_particles(_predict, (keys, ancestors), frame)
        lost = normalise(particles.log_likelihood + log_constraints).lost
        particles = particles._replace(log_likelihood=_finite(particles.log_likelihood))
        constrained = normalise(log_constraints).log_weights
        start = init_state(particles, constrained, self.stages, self.move.scale)
        first = self._step(resample_key, start, lambda keys, parents: (parents, jnp.nan), ancestors.shape[0])
        return first, Particles(states, jnp.full_like(constrained, -jnp.log(constrained.shape[0]))), lost

    def _stage(self, key: Key, climb: TemperedState, frame: Frame) -> TemperedState:
        """Resample, move at the temperature reached, reweight to the next."""
        climb, moving = self._prepared(climb)
        kept = self.options.moves + 1 if self.options.waste_free else 1

        def move(keys: Keys, parents: Extended) -> tuple[Extended, Scalar]:
            chains, rates = self._walk(keys, parents, frame, moving)
            if not self.options.waste_free:
                return chains, jnp.mean(rates)
            return jax.tree.map(lambda own, more: jnp.concatenate([own, more.reshape(-1, *own.shape[1:])]), parents, chains), jnp.mean(rates)

        return self._step(key, climb, move, climb.log_weights.shape[0] // kept)

    def _step(self, key: Key, climb: TemperedState, move: Callable[..., tuple[Extended, Any]], resampled: int) -> TemperedState:
        count, stage, at_top = climb.log_weights.shape[0], climb.stage, climb.beta >= 1
        # At the top there is nothing to reweight: the particles keep their weights, unless fewer chains than particles go on.
        kept = at_top & (resampled == count)

        def resample(key: Key, log_weights: LogWeights, count: int | None = None) -> Int[Array, " drawn"]:
            chosen = self.resample(key, log_weights, count)
            return jnp.where(kept, jnp.arange(resampled), chosen)

        def log_potential(particles: Extended) -> LogWeights:
            powered = self._increment(particles.log_likelihood, climb) * particles.log_likelihood
            return jnp.where(kept, climb.log_weights, powered)

        after = feynman_kac_step(key, climb.particles, climb.log_weights, move, log_potential, resample, resampled)
        beta = climb.beta + self._increment(after.particles.log_likelihood, climb)
        # What a sum in float32 misses of 1 would be a stage of its own.
        beta = jnp.where(beta > 1 - 1e-6, 1.0, beta)
        acceptance = jnp.asarray(after.info, climb.beta.dtype)
        follows = jnp.where(jnp.isnan(acceptance), 0.0, GAIN * (acceptance - self.move.acceptance_rate))
        return TemperedState(
            particles=after.particles,
            log_weights=after.log_weights,
            beta=beta,
            stage=stage + 1,
            stages_at_top=climb.stages_at_top + at_top,
            log_evidence=climb.log_evidence + jnp.where(at_top, 0.0, after.log_increment),
            log_scale=climb.log_scale + follows,
            ladder=climb.ladder._replace(inverse_temperatures=climb.ladder.inverse_temperatures.at[stage].set(beta)),
            survival_rates=climb.survival_rates.at[stage].set(effective_sample_size(after.log_weights) / count),
            acceptance_rates=climb.acceptance_rates.at[stage].set(acceptance),
        )

    def _increment(self, log_likelihoods: LogWeights, climb: TemperedState) -> Scalar:
        left = 1 - climb.beta
        if self.frozen is not None:
            return self.frozen.inverse_temperatures[climb.stage] - climb.beta
        last = climb.stage == self.options.most_stages - 1
        return jnp.where(last, left, next_increment(log_likelihoods, self.options.target_ess, left))

    # -- moves --------------------------------------------------------------------------------------------------------------------------

    def _prepared(self, climb: TemperedState) -> tuple[TemperedState, Moving]:
        """The scale and the whitening of the moves at the temperature reached, noted on the ladder."""
        rung = climb.stage - 1
        if self.frozen is not None:
            roots = {name: root[rung] for name, root in self.frozen.roots.items()}
            log_scale = self.frozen.log_scales[rung]
        else:
            roots = {name: whitening(position, climb.log_weights) for name, position in climb.particles.position.items()}
            log_scale = climb.log_scale
        return climb._replace(ladder=climb.ladder.noted(rung, log_scale, roots)), Moving(climb.beta, jnp.exp(log_scale), roots)

    def _walk(self, keys: Keys, particles: Extended, frame: Frame, moving: Moving) -> tuple[Extended, Float[Array, " particle"]]:
        """All particles moved: their last states, or with `waste_free` all states (particle, move, ...); and the acceptance rate of each."""
        options = self.options

        def one(own: tuple[Key, Extended], shared: tuple[Frame, Moving]) -> tuple[Extended, Scalar]:
            chain, rate = walk(*own, *shared, self.move, options.moves, options.candidates)
            kept = chain if options.waste_free else jax.tree.map(lambda leaf: leaf[-1], chain)
            return kept._replace(log_likelihood=_finite(kept.log_likelihood)), rate

        return over_particles(one, (keys, particles), (frame, moving))

    # -- results ------------------------------------------------------------------------------------------------------------------------

    def _result(self, frame: Frame, top: TemperedState, predicted: Particles, lost: Array) -> tuple[Particles, FilterInfo]:
        states = jax.vmap(state_of, (None, 0, 0))(frame, top.particles.ancestor, top.particles.position)
        found = Particles(states, normalise(top.log_weights).log_weights)
        after = jax.tree.map(lambda prediction, posterior: jnp.where(lost, prediction, posterior), predicted, found)
        info = FilterInfo(
            ancestors=top.particles.ancestor,
            ess=effective_sample_size(after.log_weights),
            survival_rate=top.survival_rates,
            inverse_temperatures=top.ladder.inverse_temperatures,
            log_evidence=jnp.where(lost, -jnp.inf, top.log_evidence),
            lost=lost,
            acceptance_rate=top.acceptance_rates,
            evaluations=self._evaluations(top),
        )
        return after, info

    def _evaluations(self, top: TemperedState) -> Array:
        """The prediction's, and of each stage those of its moves."""
        count, options = top.log_weights.shape[0], self.options
        moved = count // (options.moves + 1) if options.waste_free else count
        return count + (top.stage - 1) * moved * options.moves * self.move.evaluations


def _predict(own: tuple[Key, Index], frame: Frame) -> tuple[Extended, State, Scalar]:
    return predict(*own, frame)


def _finite(log_likelihood: Array) -> Array:
    """A likelihood of zero, or none, as a finite number."""
    return jnp.maximum(jnp.where(jnp.isnan(log_likelihood), LOG_ZERO, log_likelihood), LOG_ZERO)


@register("kernel", "tempered", Options)
def build(options: Options, **_: Any) -> Kernel:
    """The kernel of a definition."""
    return build_kernel(**options.model_dump(exclude={"particles"}))
