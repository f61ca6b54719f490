r"""Charts: unconstrained coordinates for a whole state, for samplers that move in a vector space.

Most states use `Coordinates` (density/coordinates.py): one bijection for each variable. A loose-limbed body uses `TreeChart`: the movement of the
first part, and of every other part relative to its parent, as tangent vectors $(v, \omega)$ at a reference,

$$X_r = \bar X_r\, \mathrm{Exp}(x_r), \qquad X_j = X_{\mathrm{parent}(j)}\, \bar X_{ij}\, \mathrm{Exp}(x_j), \qquad
\mathrm{Exp}(v, \omega) = (v, e^{\omega}).$$

A kinematic prior is nearly diagonal in these coordinates, and a movement of the whole body changes six of them. Products with fixed transforms do not
change the Haar measure $dt\,dR$, so only the exponential map has a Jacobian: $\sum_j \log 2 (1 - \cos|\omega_j|) / |\omega_j|^2$. It is singular at a
half turn from the reference. The reference is therefore a state of the previous frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.base.geometry import rigid, rotations
from bayes_body.base.geometry.namespaces import namespace
from bayes_body.base.shapes import Scalar
from bayes_body.density.factor import State


class Chart(Protocol):
    """The map between a state's sampled variables and a position, which maps each variable to an unconstrained vector."""

    def constrain(self, position: State) -> dict[str, Array]:
        """Return the sampled variables at a position."""
        ...

    def unconstrain(self, state: State) -> dict[str, Array]:
        """Return the position of a state. Variables that are not sampled are left out."""
        ...

    def log_determinant(self, position: State) -> Scalar:
        """Return the log-Jacobian, which is added to a log-density of the state to give the log-density of the position."""
        ...


@partial(jax.tree_util.register_dataclass, meta_fields=["name", "parents"], data_fields=["references"])
@dataclass(frozen=True)
class TreeChart:
    """Coordinates of rigid parts in a tree (see the module's formula).

    Attributes:
        name: the variable, with values (part, 7); its position is (6 part,).
        parents: for each part its parent, which comes earlier; -1 for the first part.
        references: the first part, and every other part relative to its parent.
    """

    name: str
    parents: tuple[int, ...]
    references: Float[Array, "part 7"]

    def constrain(self, position: State) -> dict[str, Array]:
        """Return the parts at a position."""
        steps = position[self.name].reshape(-1, 6)
        transforms = rigid.compose(self.references, rigid.rigid(steps[:, :3], rotations.exponential(steps[:, 3:])))
        parts: list[Array] = []
        for part, parent in enumerate(self.parents):
            parts.append(jnp.asarray(transforms[part] if parent < 0 else rigid.compose(parts[parent], transforms[part])))
        return {self.name: jnp.stack(parts)}

    def unconstrain(self, state: State) -> dict[str, Array]:
        """Return the position of the parts."""
        steps = rigid.relative(self.references, relative_to_parents(state[self.name], self.parents))
        return {self.name: jnp.concatenate([steps[:, :3], rotations.logarithm(steps[:, 3:])], axis=1).ravel()}

    def log_determinant(self, position: State) -> Scalar:
        """Return the sum over the parts of the exponential map's log-Jacobian."""
        return jnp.sum(rotations.log_jacobian(position[self.name].reshape(-1, 6)[:, 3:]))


@partial(jax.tree_util.register_dataclass, meta_fields=["names"], data_fields=["chart"])
@dataclass(frozen=True)
class ChartBeside:
    """Coordinates of a state with further variables, which are numbers without limits and their own coordinates."""

    names: tuple[str, ...]
    chart: Chart

    def constrain(self, position: State) -> dict[str, Array]:
        """Return the sampled variables at a position."""
        return {**self.chart.constrain(position), **{name: position[name] for name in self.names}}

    def unconstrain(self, state: State) -> dict[str, Array]:
        """Return the position of a state."""
        return {**self.chart.unconstrain(state), **{name: state[name] for name in self.names}}

    def log_determinant(self, position: State) -> Scalar:
        """Return the log-Jacobian, that of the other variables."""
        return self.chart.log_determinant(position)


def relative_to_parents[Parts: Array | np.ndarray](parts: Parts, parents: Sequence[int]) -> Parts:
    """Return every part relative to its parent; the first part stays as it is."""
    above = np.array([max(parent, 0) for parent in parents])
    first = np.array([parent < 0 for parent in parents])
    return namespace(parts).where(first[:, None], parts, rigid.relative(parts[above], parts))


@partial(jax.tree_util.register_dataclass, meta_fields=["name", "parents"], data_fields=[])
@dataclass(frozen=True)
class ChartAround:
    """The `chart` of a transition of a tree of parts: it makes coordinates around a state."""

    name: str
    parents: tuple[int, ...]

    def __call__(self, reference: State) -> TreeChart:
        """Return the coordinates. The quaternions of the reference are normalised, since many products make them drift."""
        relative = relative_to_parents(reference[self.name], self.parents)
        unit = jnp.asarray(rigid.rigid(relative[:, :3], rotations.normalised(relative[:, 3:])))
        return TreeChart(self.name, self.parents, unit)
