"""The terms of a path and their derivatives: the factors of each frame, and the transitions between neighbouring frames."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpyro.distributions import Distribution, Independent

from bayes_body.base.shapes import Scalar
from bayes_body.density.expansion import expand, without_negative
from bayes_body.density.factor import Particles, State, Transition, nothing_derived
from bayes_body.density.frames import Frames, Inputs
from bayes_body.density.gaussian_view import joined, split
from bayes_body.kernels.batching import over_particles

# Frames in a batch.
FRAMES = 10


class Links(NamedTuple):
    """The transitions near a path, one for each pair of neighbouring frames.

    Attributes:
        value: their log-densities.
        by_previous: their gradients by the earlier frame.
        by_current: their gradients by the later frame.
        blocks: for each entry, minus the second derivatives by its value and its centre.
        slope: F, the derivative of the centres by the earlier frame.
    """

    value: Float[Array, " link"]
    by_previous: Float[Array, "link entry"]
    by_current: Float[Array, "link entry"]
    blocks: Float[Array, "link entry 2 2"]
    slope: Float[Array, "link entry entry"]


class Terms(NamedTuple):
    """All terms near a path.

    Attributes:
        value: the log-potentials of each frame's factors.
        gradient: their gradients; 0 for entries that they do not read.
        precision: their precisions; likewise.
        links: the transitions.
    """

    value: Float[Array, " frame"]
    gradient: Float[Array, "frame entry"]
    precision: Float[Array, "frame entry entry"]
    links: Links


def terms_near(frames: Frames, unlimited: Transition, form: State, path: Float[Array, "frame entry"]) -> Terms:
    """Return the terms near a path; `form` is the state of a frame, for the shapes."""
    read = _read(frames, form)

    def of_frame(item: tuple[Inputs, Array], frames: Frames) -> tuple[Scalar, Array, Array]:
        frame, row = item

        def state_of(entries: Array) -> State:
            return frames.transition.with_derived(split(row.at[read].set(entries), form))

        value, gradient, precision = expand(frames.density(frame, Particles({}, jnp.zeros(1))), state_of, row[read])
        every = jnp.zeros((*row.shape, *row.shape), row.dtype).at[np.ix_(read, read)].set(precision)
        return value, jnp.zeros_like(row).at[read].set(gradient), every

    of_frames = over_particles(of_frame, (frames.inputs, path), frames, FRAMES)
    links = over_particles(lambda rows, transition: _link(transition, form, *rows), (path[:-1], path[1:]), unlimited, FRAMES)
    value, gradient, precision = of_frames
    return Terms(value, gradient, precision, links)


def _read(frames: Frames, form: State) -> np.ndarray:
    """Return the indices of the entries that factors read. If variables are derived, which may come from any of them, these are all."""
    scope = {variable.name for factor in frames.factors for variable in factor.scope}
    derives = getattr(frames.transition.derive, "func", frames.transition.derive) is not nothing_derived
    return np.flatnonzero(np.concatenate([np.full(form[name].shape[0], derives or name in scope) for name in sorted(form)]))


def _link(transition: Transition, form: State, previous: Float[Array, " entry"], current: Float[Array, " entry"]) -> Links:
    """Return one transition near a pair of frames. All derivatives are those of its distributions' own `log_prob`."""
    value, (by_previous, by_current) = jax.value_and_grad(
        lambda previous, current: transition.log_density(split(current, form), split(previous, form)), argnums=(0, 1)
    )(previous, current)
    distributions = transition.conditional(split(previous, form))

    def about(values: Array, centres: Array) -> Scalar:
        a, b = split(values, form), split(centres, form)
        return sum((jnp.asarray(_centred(d, b[name]).log_prob(a[name])) for name, d in distributions.items()), jnp.zeros(()))

    def centres(previous: Array) -> Array:
        return joined({name: base_of(d).loc for name, d in transition.conditional(split(previous, form)).items()})

    # Entries are independent: one direction for values and one for centres give the second derivatives of all.
    ones, zeros = jnp.ones_like(current), jnp.zeros_like(current)
    point = (current, centres(previous))
    columns = [jnp.stack(jax.jvp(jax.grad(about, argnums=(0, 1)), point, direction)[1], axis=-1) for direction in ((ones, zeros), (zeros, ones))]
    return Links(value, by_previous, by_current, without_negative(-jnp.stack(columns, axis=-1)), jax.jacfwd(centres)(previous))


def base_of(distribution: Distribution) -> Any:
    """Return the distribution of the single entries."""
    return distribution.base_dist if isinstance(distribution, Independent) else distribution


def _centred(distribution: Distribution, centre: Array) -> Distribution:
    """Return the distribution with another centre."""
    loc = base_of(distribution).loc
    leaves, form = jax.tree.flatten(distribution)
    return jax.tree.unflatten(form, [centre if leaf is loc else leaf for leaf in leaves])
