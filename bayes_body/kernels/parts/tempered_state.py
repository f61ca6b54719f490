"""How far a tempered run has come: its particles at the temperature reached, and the ladder of temperatures behind them."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from bayes_body.kernels.parts.extended import Extended
from bayes_body.kernels.parts.weights import LogWeights
from bayes_body.shapes import Index, Scalar


class Ladder(NamedTuple):
    """What a run chose: each stage's temperature, and how it moved there (size of a step, whitening); NaN beyond the stages so far."""

    inverse_temperatures: Float[Array, " stage"]
    log_scales: Float[Array, " stage"]
    roots: dict[str, Float[Array, "stage dof dof"]]

    def noted(self, rung: Index, log_scale: Scalar, roots: Mapping[str, Float[Array, "dof dof"]]) -> "Ladder":
        """With how the particles move at a rung."""
        noted = {name: self.roots[name].at[rung].set(root) for name, root in roots.items()}
        return self._replace(log_scales=self.log_scales.at[rung].set(log_scale), roots=noted)


class TemperedState(NamedTuple):
    """What a stage hands to the next; rates have a value a stage, as the ladder has."""

    particles: Extended
    log_weights: LogWeights
    beta: Scalar
    stage: Int[Array, ""]
    stages_at_top: Int[Array, ""]
    log_evidence: Scalar
    log_scale: Scalar
    ladder: Ladder
    survival_rates: Float[Array, " stage"]
    acceptance_rates: Float[Array, " stage"]


def init_state(particles: Extended, log_weights: LogWeights, stages: int, scale: Callable[[int], float]) -> TemperedState:
    """At temperature zero, before any stage.

    Args:
        particles: of the prediction.
        log_weights: of the particles, by their constraints.
        stages: that there may be at most.
        scale: the size of the first step, by the number of coordinates.
    """
    dtype = log_weights.dtype
    unknown = jnp.full((stages,), jnp.nan, dtype)
    roots = {name: jnp.full((stages, x.shape[1], x.shape[1]), jnp.nan, dtype) for name, x in particles.position.items()}
    log_scale = jnp.log(jnp.asarray(scale(sum(x.shape[1] for x in particles.position.values())), dtype))
    zero, none = jnp.zeros((), dtype), jnp.zeros((), int)
    return TemperedState(particles, log_weights, zero, none, none, zero, log_scale, Ladder(unknown, unknown, roots), unknown, unknown)
