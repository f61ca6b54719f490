r"""An unknown: a variable of the state that changes slowly, with a prior around what the session says, and what it changes in the factors.

Its value x, one number for each entry, follows a walk that returns to its mean (a stationary Ornstein-Uhlenbeck process),

$$x_0 \sim \mathcal N(\mu, \sigma^2), \qquad x_t \sim \mathcal N\big(\mu + \phi\,(x_{t-1} - \mu),\ (1 - \phi^2)\,\sigma^2\big), \qquad
\phi = e^{-\Delta t / \tau},$$

whose standard deviation is σ in every frame. The time τ says for how long an error lasts. Errors of networks last for some seconds, and a value that
never changed would be believed too soon. A body's lengths never change: their τ is long.

An unknown changes nodes of one type in the factors' pytrees, such as every `Body` or every `Camera`. What a factor computes is not touched.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpyro.distributions import Distribution, Normal

from bayes_body.base.geometry.camera import Camera
from bayes_body.base.geometry.namespaces import device_array
from bayes_body.base.shapes import Key, Scalar
from bayes_body.base.toml.schema import Count, Schema
from bayes_body.density.factor import Factor, Numbered, Side, State, Variables
from bayes_body.density.plate import Plate
from bayes_body.density.spaces import Flat, euclidean
from bayes_body.kernels.laplace.proposal import balanced_noise
from bayes_body.model.body.schema import BodySchema
from bayes_body.model.body.solids import Body
from bayes_body.model.dynamics.diffusion import by_dof, key_of
from bayes_body.recording.session.session import CameraUncertainty, Subject

SIDES: tuple[Side, ...] = ("prior", "likelihood", "constraint")


class Setting(NamedTuple):
    """What an unknown is built for.

    Attributes:
        body: the body of the session's subject.
        schema: the body file.
        rig: the session's cameras, stacked.
        cameras: their names.
        fps: frames per second.
        has_height: whether the session gives the subject's height.
        measured: names of the lengths that the session gives.
        subject: what the session says of the subject, as far as it is said of this body.
        uncertainties: what it says of how well each camera is known.
    """

    body: Body
    schema: BodySchema
    rig: Camera
    cameras: tuple[str, ...]
    fps: float
    has_height: bool
    measured: frozenset[str] = frozenset()
    subject: Subject = Subject()
    uncertainties: tuple[CameraUncertainty, ...] = ()


class UnknownSchema(Schema):
    """Options of every unknown."""

    least_cameras: Count = 2
    """with fewer cameras that have what the model reads, the session's word is taken as exact. One view tells little of sizes and places."""


def unchanged(node: Any) -> Any:
    """Return a node as it is: the default `prepare`."""
    return node


@partial(
    jax.tree_util.register_dataclass,
    meta_fields=["name", "space", "node", "sides", "prepare", "reads", "moves"],
    data_fields=["mean", "sd", "retention", "change", "mixing"],
)
@dataclass(frozen=True)
class Unknown:
    """A variable that changes slowly.

    Attributes:
        name: the variable.
        space: its space, with a label and a unit for each entry, or for what they mix to.
        node: the type of the nodes that it changes.
        change: `(node, value, variables) -> node`; a `jax.tree_util.Partial`.
        mean: the prior's mean.
        sd: the prior's standard deviations.
        retention: share of the distance to the mean that is left in the next frame, for each entry.
        sides: the sides of the factors that it changes.
        prepare: `node -> node`, what is done to the nodes once, when the model is built.
        reads: other variables that `change` needs, such as `velocity`.
        mixing: the labels name `mixing @ value`, quantities that are correlated in the prior while all kernels see independent entries; None if they
            name the entries themselves.
        moves: the camera or marker of each entry, if an entry changes what is expected of this one alone, which makes frames cheaper; else None.
    """

    name: str
    space: Flat
    node: type
    change: Callable[[Any, Array, Variables], Any]
    mean: Float[Array, " entry"]
    sd: Float[Array, " entry"]
    retention: Float[Array, " entry"]
    sides: tuple[Side, ...] = SIDES
    prepare: Callable[[Any], Any] = unchanged
    reads: tuple[str, ...] = ()
    mixing: Float[Array, "entry entry"] | None = None
    moves: Numbered | None = None

    def prior(self) -> Distribution:
        """Return the distribution in any frame, if nothing is known."""
        return Normal(self.mean, self.sd).to_event(1)

    def onward(self, previous: Float[Array, " entry"]) -> Distribution:
        """Return the distribution in the next frame."""
        return Normal(self.mean + self.retention * (previous - self.mean), self._noise).to_event(1)

    @property
    def _noise(self) -> Float[Array, " entry"]:
        # 1 - φ² loses all digits if φ is near to 1.
        return self.sd * jnp.sqrt(-jnp.expm1(2 * jnp.log(self.retention)))

    def noise_about(self, value: Float[Array, " entry"], scale: Scalar) -> Distribution:
        """Return the noise of one frame about a value, with its standard deviation multiplied by `scale`."""
        return Normal(value, scale * self._noise).to_event(1)

    def named(self, values: Float[np.ndarray, "*batch entry"]) -> Float[np.ndarray, "*batch entry"]:
        """Return what the labels name."""
        return values if self.mixing is None else values @ np.asarray(self.mixing, float).T

    def named_sd(self) -> Float[np.ndarray, " entry"]:
        """Return the prior's standard deviations of what the labels name."""
        sd = np.asarray(self.sd, float)
        return sd if self.mixing is None else np.linalg.norm(np.asarray(self.mixing, float) * sd, axis=1)

    def concerns(self, factor: Factor) -> bool:
        """Whether a factor holds a node that this changes, or is a plate of which it is a size."""
        if factor.side not in self.sides:
            return False
        if isinstance(factor.log_potential, Plate):
            return self.name in factor.log_potential.resize
        nodes = jax.tree.leaves(factor, is_leaf=lambda node: isinstance(node, self.node))
        return any(isinstance(node, self.node) for node in nodes)


def unknown_about_zero(
    name: str,
    labels: tuple[str, ...],
    units: tuple[str, ...],
    sd: list[float],
    lasts_s: float,
    setting: Setting,
    node: type,
    change: Callable[..., Any],
    *arguments: Any,
    **attributes: Any,
) -> Unknown:
    """Return an unknown whose prior has the mean 0.

    Args:
        name: the variable.
        labels: a name for each entry.
        units: the unit of each.
        sd: standard deviation of each.
        lasts_s: after this time an error has faded to 37 %, seconds.
        setting: what it is built for.
        node: the type of the nodes that it changes.
        change: `(*arguments, node, value, variables) -> node`.
        arguments: the first arguments of `change`.
        attributes: further attributes of `Unknown`.
    """
    dtype = setting.body.lengths.dtype
    retention = np.full(len(sd), math.exp(-1 / (setting.fps * lasts_s)))
    return Unknown(
        name,
        euclidean(labels, units, f"{name}_entry"),
        node,
        jax.tree_util.Partial(change, *arguments),
        mean=device_array(np.zeros(len(sd)), dtype),
        sd=device_array(sd, dtype),
        retention=device_array(retention, dtype),
        **attributes,
    )


def deviations(table: Mapping[str, float], usual: Mapping[str, float], names: tuple[str, ...], field: str, kind: str) -> list[float]:
    """Return the number of each name: that of the user's table, by name or by the first pattern that matches, else the usual one.

    Args:
        table: the user's.
        usual: patterns; `*` matches the rest.
        names: names of bones, parts or markers.
        field: the table in error messages.
        kind: what the names name, in error messages.

    Raises:
        InputError: a key of the user's table matches no name.
    """
    numbers = by_dof(table, names, field, kind)
    return [numbers[name] if name in numbers else usual[key_of(name, usual) or "*"] for name in names]


def prior_draws(key: Key, unknowns: tuple[Unknown, ...], count: int) -> dict[str, Array]:
    """Return draws of the unknowns, (draw, entry) each, which have the prior's mean and covariance exactly if there are enough of them."""
    sizes = [term.sd.shape[0] for term in unknowns]
    pieces = jnp.split(balanced_noise(key, count, sum(sizes)), np.cumsum(sizes)[:-1], axis=1)
    return {term.name: term.mean + term.sd * piece for term, piece in zip(unknowns, pieces, strict=True)}


def centred(term: Unknown, mean: Sequence[float]) -> Unknown:
    """Return an unknown with another prior mean."""
    return replace(term, mean=device_array(list(mean), term.mean.dtype))


def initial_values(unknowns: tuple[Unknown, ...]) -> State:
    """Return the value of each unknown that the session gives."""
    return {term.name: term.mean for term in unknowns}
