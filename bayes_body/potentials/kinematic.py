r"""The joints of a loose-limbed body: a density of each part's pose relative to its parent's (Sigal et al. 2011, (3), (5), (6)).

$$\psi(X_i, X_j) = g(X_i^{-1} X_j), \qquad
g(Y) = \sum_m \delta_m\, \frac{\mathcal N(\xi_m; 0, \Sigma_m)}{P_m\, J(\omega_m)}, \qquad
\xi_m = (v_m, \omega_m) = \mathrm{Exp}^{-1}(\bar Y_m^{-1} Y),$$

a Gaussian mixture in the tangent space at mean relative poses $\bar Y_m$. $J = 2 (1 - \cos|\omega|) / |\omega|^2$ is the Jacobian of the exponential
map, and $P_m$ the mass of the Gaussian within a half turn, so g is normalised with respect to the Haar measure $dt\,dR$. SE(3) is unimodular: the
same function is the conditional density of a child given its parent and of a parent given its child, and a tree of edges is a normalised prior given
its root. The paper learns two functions for the two directions. g does not change under q → −q.
"""

import math
from collections.abc import Mapping
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydantic import Field
from scipy.stats import norm, qmc

from bayes_body.body.placement import PARTS, ByParts, require
from bayes_body.body.solids import Body
from bayes_body.density.chart import relative_to_parents
from bayes_body.density.factor import Factor
from bayes_body.density.plate import Plate, plate_factor
from bayes_body.errors import InputError, input_error, nearest
from bayes_body.geometry import rigid, rotations
from bayes_body.potentials.widths import widths_by_part
from bayes_body.registry import register
from bayes_body.shapes import Key, Scalar
from bayes_body.toml.schema import Finite, Positive, Schema

type Width = Positive | tuple[Positive, Positive, Positive]
# Points of the quasi-random sum for the mass within a half turn: its error is below 1e-5.
POINTS = 2**15


class Component(Schema):
    """A `[[potential.component]]` of `[[potential]] kind = "kinematic"`.

    The mean relative poses are those of the body with the joint angles `mean_deg`, 0 where none is given. `relative` gives the pose of a part in its
    parent's frame itself: x, y, z in metres and a unit quaternion w, x, y, z. `sd_m` and `sd_deg` are standard deviations in the child's frame: one
    number, or one for each axis; by names of parts or patterns.
    """

    weight: Positive = 1.0
    mean_deg: Mapping[str, Finite] = {}
    relative: Mapping[str, tuple[Finite, Finite, Finite, Finite, Finite, Finite, Finite]] = {}
    sd_m: Mapping[str, Width] = {"*": 0.02}
    sd_deg: Mapping[str, Width] = {"*": 30.0}


class Options(Schema):
    """Options of `[[potential]] kind = "kinematic"`: the components of the mixture, with equal weights at every joint."""

    component: Annotated[tuple[Component, ...], Field(min_length=1)] = (Component(),)


def log_density(edge: Mapping[str, Array], parent: Float[Array, "7"], child: Float[Array, "7"]) -> Scalar:
    """Return log g of one edge.

    Args:
        edge: `mean` (component, 7), `sd` (component, 6), `log_weight` (component,), which includes the normalisers.
        parent: the pose of the parent.
        child: the pose of the child.
    """
    steps = rigid.relative(edge["mean"], rigid.relative(parent, child)[None])
    w = rotations.logarithm(steps[:, 3:])
    xi = jnp.concatenate([steps[:, :3], w], axis=1) / edge["sd"]
    each = edge["log_weight"] - 0.5 * jnp.sum(xi * xi, axis=1) - rotations.log_jacobian(w)
    return each[0] if each.shape == (1,) else jax.nn.logsumexp(each)


def draw(key: Key, edge: Mapping[str, Array], known: Float[Array, "7"], reverse: bool = False) -> Float[Array, "7"]:
    """Draw a child given its parent, or with `reverse` a parent given its child, from g. Rotations beyond a half turn are drawn again."""
    choice_key, step_key = jax.random.split(key)
    # The weights without the constants of the Gaussians.
    component = jax.random.categorical(choice_key, jnp.log(edge["weight"]))
    sd = edge["sd"][component]

    def too_far(state: tuple[Key, Array]) -> Array:
        return jnp.sum(state[1][3:] ** 2) >= math.pi**2

    def again(state: tuple[Key, Array]) -> tuple[Key, Array]:
        next_key, use = jax.random.split(state[0])
        return next_key, sd * jax.random.normal(use, (6,), sd.dtype)

    _, step = jax.lax.while_loop(too_far, again, (step_key, jnp.full((6,), jnp.inf, sd.dtype)))
    relative = rigid.compose(edge["mean"][component], rigid.rigid(step[:3], rotations.exponential(step[3:])))
    return jnp.asarray(rigid.compose(known, rigid.inverse(relative) if reverse else relative))


def draw_tree(key: Key, factor: Factor, root: Float[Array, "7"]) -> Float[Array, "part 7"]:
    """Draw all parts given the first one, from the prior that the kinematic edges define. Parents come before their children."""
    plate: Any = factor.log_potential
    parts = {plate.rows[0][0]: root}
    for row, (parent, child) in enumerate(plate.rows):
        edge = jax.tree.map(lambda leaf, row=row: leaf[row], plate.parameters)
        parts[child] = draw(jax.random.fold_in(key, row), edge, parts[parent])
    return jnp.stack([parts[part] for part in sorted(parts)])


@register("potential", "kinematic", Options)
def build(name: str, options: Options, body: Body, **_: Any) -> Factor:
    """Build the plate of all joints of a loose-limbed body.

    Raises:
        InputError: the body is placed by angles; a name of a dof or part does not exist; a quaternion is not of length one.
    """
    require(body, PARTS, "potential 'kinematic'", "dynamics and limits of joint angles")
    placement = body.placement
    assert isinstance(placement, ByParts)
    rows = tuple((parent, child) for child, parent in enumerate(placement.parents) if parent >= 0)
    children = [child for _, child in rows]
    means = np.stack([_means(name, component, body)[children] for component in options.component], axis=1)
    names = tuple(placement.names[child] for child in children)
    widths = [widths_by_part(name, names, component.sd_m, component.sd_deg) for component in options.component]
    sd, weights = np.stack(widths, axis=1), np.array([component.weight for component in options.component])
    weights = np.broadcast_to(weights / weights.sum(), sd.shape[:2])
    constants = np.log(weights) - np.log(sd).sum(axis=2) - 3 * math.log(2 * math.pi) - np.log(within_half_turn(sd[..., 3:]))
    dtype = body.lengths.dtype
    arrays = {"mean": means, "sd": sd, "weight": weights, "log_weight": constants}
    parameters = {key: jnp.asarray(value, dtype) for key, value in arrays.items()}
    plate = Plate(PARTS, rows, jax.tree_util.Partial(log_density), parameters, draw=jax.tree_util.Partial(draw))
    return plate_factor(name, "prior", plate)


def _means(name: str, component: Component, body: Body) -> Float[np.ndarray, "part 7"]:
    """Return the mean pose of every part in its parent's frame."""
    placement = body.placement
    assert isinstance(placement, ByParts)
    for dof in component.mean_deg:
        if dof not in body.dof_names:
            raise InputError(f"{name}: mean_deg.{dof}: no dof of the body '{body.name}'; {nearest(dof, body.dof_names)}")
    pose = jnp.asarray([math.radians(component.mean_deg.get(dof, 0.0)) for dof in body.dof_names], body.lengths.dtype)
    relative = np.array(relative_to_parents(jnp.asarray(placement.configuration(body.skeleton, pose)), placement.parents), float)
    for part, given in component.relative.items():
        if part not in placement.names:
            raise InputError(f"{name}: relative.{part}: no part of the body '{body.name}'; {nearest(part, placement.names)}")
        length = math.sqrt(sum(each * each for each in given[3:]))
        if abs(length - 1) > 1e-3:
            found, remedy = f"a quaternion of length {length:.4g}", "give w, x, y, z of a rotation, such as 1, 0, 0, 0"
            raise input_error(f"{name}: relative.{part}", found, "length 1, or it is no rotation", remedy)
        relative[placement.names.index(part)] = (*given[:3], *(each / length for each in given[3:]))
    return relative


def within_half_turn(sd: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch"]:
    """Return the probability that a normal rotation vector with these standard deviations, radians, is shorter than π."""
    z = norm.ppf(qmc.Sobol(3, scramble=True, rng=0).random(POINTS))
    return np.mean(np.sum((sd[..., None, :] * z) ** 2, axis=-1) < math.pi**2, axis=-1)
