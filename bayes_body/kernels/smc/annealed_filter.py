r"""The annealed particle filter (Deutscher & Reid 2005).

**A mode seeker, not a posterior sampler**: its particles gather at high values of the likelihood, and their spread does not measure uncertainty. It
does not estimate the evidence, which is reported as NaN.

A frame has layers $r = R \ldots 1$. At each layer, particles are resampled, crossed over, moved by the prior's noise with its standard deviation
multiplied by $\tau^{R-r}$ (Darby et al. 2008, (10)), and weighted by $w^{\beta_r}$. Bisection finds the $\beta_r$ at which the survival rate
$1 / (N \sum_n \pi_n^2)$ is $\tau$. The noise of the layers is a proposal that no weight corrects. This makes the filter a mode seeker. A motion prior
may have its own proposal for the layers (`Transition.explore`).

Crossover: a particle takes an interval of its parameters (a piece of a chain of joints, or of the list of parts) from a second parent, which is drawn
by weight.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from bayes_body.base.registry import register
from bayes_body.base.shapes import Index, Key, Scalar
from bayes_body.base.toml.read import validate
from bayes_body.base.toml.schema import Count, ProperShare, Schema, Share
from bayes_body.density.density import Density
from bayes_body.density.factor import Particles, State, Transition, draw
from bayes_body.density.kernel import FilterInfo, Kernel
from bayes_body.kernels.batching import over_particles
from bayes_body.kernels.weights import LogWeights, Resample, Scheme, Weighed, effective_sample_size, normalise, resampler, weigh

# Limits of the bisection for the likelihood's power, and its number of steps, which gives a precision of 1e-7 in the logarithm.
LOWEST_POWER, HIGHEST_POWER = 1e-6, 1e6
BISECTIONS = 28


class Options(Schema):
    """Options of `[kernel] kind = "annealed"`."""

    particles: Count = 1000
    """[particles] per run."""
    layers: Count = 5
    """annealing layers per frame."""
    survival_rate: ProperShare = 0.5
    """τ, the fraction of particles that a layer keeps, and the factor by which the noise shrinks from layer to layer."""
    crossover_rate: Share = 0.5
    """from the second layer on, the fraction of particles that take a sequence of consecutive parameters from a second parent."""
    resampling: Scheme = "systematic"
    """`"systematic"`, `"stratified"`, `"multinomial"` or `"residual"`."""


class _Layer(NamedTuple):
    """The state passed from layer to layer: particles, their ancestors in the previous frame, and whether a layer had no particle with weight."""

    states: State
    log_weights: LogWeights
    ancestors: Int[Array, " particle"]
    lost: Bool[Array, ""]


def build_kernel(layers: int = 5, survival_rate: float = 0.5, crossover_rate: float = 0.5, resampling: Scheme = "systematic") -> Kernel:
    """Return a kernel that filters one frame.

    Args:
        layers: R, the number of annealing layers per frame.
        survival_rate: τ, the fraction of particles that survive a layer; also the factor by which the noise shrinks.
        crossover_rate: from the second layer on, the fraction of particles that take an interval of a second parent's parameters.
        resampling: how ancestors are drawn.

    Raises:
        InputError: an argument is outside its range.
    """
    # The arguments of a script have not been checked yet.
    validate(Options, {"layers": layers, "survival_rate": survival_rate, "crossover_rate": crossover_rate, "resampling": resampling}, "annealed()")
    resample = resampler(resampling)
    scales = survival_rate ** jnp.arange(layers)

    def kernel(key: Key, particles: Particles, density: Density) -> tuple[Particles, FilterInfo]:
        count = particles.log_weights.shape[0]

        def layer(previous_layer: _Layer, step: tuple[Key, Index, Scalar]) -> tuple[_Layer, tuple[Scalar, Scalar]]:
            layer_key, index, scale = step
            select_key, cross_key, move_key = jax.random.split(layer_key, 3)
            chosen = resample(select_key, previous_layer.log_weights)
            parents = jax.tree.map(lambda leaf: leaf[chosen], previous_layer.states)
            rate = jnp.where(index > 0, crossover_rate, 0.0)
            parents = _cross_over(cross_key, parents, previous_layer, resample, rate, density.transition)
            ancestors = previous_layer.ancestors[chosen]
            previous = jax.tree.map(lambda leaf: leaf[ancestors], particles.states)
            keys = jax.random.split(move_key, count)
            moved: Weighed = over_particles(_move_and_weigh, (keys, parents, previous), (density, index, scale))
            # A prior's potentials are annealed like the likelihood: at full power few particles would survive the first layer.
            annealed = moved.log_likelihoods + moved.log_potentials
            beta = _power_for_survival(annealed, moved.log_constraints, survival_rate)
            weights = normalise(beta * annealed + moved.log_constraints)
            rate_reached = effective_sample_size(weights.log_weights) / count
            return _Layer(moved.states, weights.log_weights, ancestors, previous_layer.lost | weights.lost), (beta, rate_reached)

        keys = jax.random.split(key, layers)
        start = _Layer(particles.states, particles.log_weights, jnp.arange(count), jnp.array(False))
        final, (betas, rates) = jax.lax.scan(layer, start, (keys, jnp.arange(layers), scales))
        info = FilterInfo(
            ancestors=final.ancestors,
            ess=rates[-1] * count,
            survival_rate=rates,
            inverse_temperatures=betas,
            log_evidence=jnp.full((), jnp.nan),
            lost=final.lost,
            acceptance_rate=jnp.full_like(rates, jnp.nan),
            evaluations=jnp.asarray(layers * count),
        )
        return Particles(final.states, final.log_weights), info

    return kernel


def _move_and_weigh(particle: tuple[Key, State, State], shared: tuple[Density, Index, Scalar]) -> Weighed:
    """Return the moved particle with the terms of its weight. The first layer draws from the motion prior; the others add its noise, scaled down."""
    key, parent, previous = particle
    density, index, scale = shared
    transition = density.transition
    if transition.explore is None:
        first, perturbed = dict(transition.conditional(previous)), dict(transition.perturbation(parent, scale))
        if jax.tree.structure(first) == jax.tree.structure(perturbed):
            # One draw instead of two: each occurrence of a random generator adds to the compile time.
            chosen = jax.tree.map(lambda prior, noise: jnp.where(index == 0, prior, noise), first, perturbed)
            return weigh(transition.state(previous, draw(key, chosen)), previous, density)
    state = jax.lax.cond(index == 0, lambda: transition.enter(key, previous), lambda: transition.perturb(key, parent, previous, scale))
    return weigh(state, previous, density)


def _cross_over(key: Key, parents: State, layer: _Layer, resample: Resample, rate: Scalar, transition: Transition) -> State:
    second_key, shuffle_key, interval_key, share_key = jax.random.split(key, 4)
    # Systematic draws come in the order of the particles. Without the shuffle, a particle would be crossed with itself.
    second = jax.random.permutation(shuffle_key, resample(second_key, layer.log_weights))
    takes_part = jax.random.uniform(share_key, second.shape) < rate

    def cross(name: str, first: Array, partner: Array) -> Array:
        # The interval consists of whole blocks, so that a rotation is not split.
        blocks = np.asarray(transition.space(name, first.shape[1:]).blocks)
        ends = jnp.sort(jax.random.randint(keys[name], (first.shape[0], 2), 0, blocks.max() + 2), axis=1)
        swapped = (blocks >= ends[:, :1]) & (blocks < ends[:, 1:]) & takes_part[:, None]
        return jnp.where(swapped.reshape(first.shape), partner, first)

    keys = dict(zip(sorted(parents), jax.random.split(interval_key, len(parents)), strict=True))
    return {name: cross(name, leaf, layer.states[name][second]) for name, leaf in parents.items()}


def _power_for_survival(log_likelihood: LogWeights, log_constraint: LogWeights, survival_rate: float) -> Scalar:
    """Return the β that gives the survival rate, by bisection on log β. The survival rate decreases as β increases."""
    # The maximum is subtracted first. Otherwise large powers would lose the differences between particles in float32.
    clean = jnp.where(jnp.isnan(log_likelihood) | jnp.isneginf(log_constraint), -jnp.inf, log_likelihood)
    relative = clean - jnp.max(jnp.where(jnp.isfinite(clean), clean, -jnp.inf))
    count = log_likelihood.shape[0]

    def halve(_: Index, ends: tuple[Scalar, Scalar]) -> tuple[Scalar, Scalar]:
        low, high = ends
        middle = (low + high) / 2
        too_cold = effective_sample_size(jnp.exp(middle) * relative + log_constraint) < survival_rate * count
        return jnp.where(too_cold, low, middle), jnp.where(too_cold, middle, high)

    ends = (jnp.log(jnp.asarray(LOWEST_POWER, relative.dtype)), jnp.log(jnp.asarray(HIGHEST_POWER, relative.dtype)))
    return jnp.exp(jax.lax.fori_loop(0, BISECTIONS, halve, ends)[0])


NOTE = "a mode seeker: it finds the pose, but the spread of its particles does not measure uncertainty; coverage and evidence are left out."


@register("kernel", "annealed", Options, NOTE, samples_posterior=False, by_particles=True)
def build(options: Options, **_: Any) -> Kernel:
    """Build the kernel from a definition's options."""
    return build_kernel(options.layers, options.survival_rate, options.crossover_rate, options.resampling)
