r"""The joints of a loose-limbed body: a density of each part's pose relative to its parent's (Sigal et al. 2011, (3), (5), (6)).

$$\psi(X_i, X_j) = g(X_i^{-1} X_j),$$

with a Gaussian mixture g in the tangent spaces at mean relative poses (`potentials.joint_mixture`), normalised with respect to the Haar measure
$dt\,dR$. SE(3) is unimodular: the same function is the conditional density of a child given its parent and of a parent given its child, and a tree of
edges is a normalised prior given its root. The paper learns two functions for the two directions.

If the parts' lengths are unknown, the joint is where the parent's length $\bar\ell e^x$ puts it: with its place $p$ in the parent's frame, where all
angles are 0, the mean positions of all components are displaced by $(e^x - 1) p$. The displacements from $p$ stay. Given x, the density is normalised
as before.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydantic import Field, model_validator

from bayes_body.base.errors import InputError, input_error, nearest
from bayes_body.base.geometry import rigid, rotations
from bayes_body.base.geometry.namespaces import device_array
from bayes_body.base.registry import register
from bayes_body.base.shapes import Key, Scalar
from bayes_body.base.toml.schema import Finite, Positive, Schema
from bayes_body.density.chart import relative_to_parents
from bayes_body.density.factor import Factor
from bayes_body.density.plate import Plate, plate_factor
from bayes_body.model.body.placed_body import require
from bayes_body.model.body.placement import LENGTHS, PARTS, ByParts
from bayes_body.model.body.solids import Body
from bayes_body.model.potentials.joint_mixture import load_joint_mixtures, log_of_components, log_pairs, mixture, times
from bayes_body.model.potentials.widths import widths_by_part

type Width = Positive | tuple[Positive, Positive, Positive]


class Component(Schema):
    """A `[[potential.component]]` of `[[potential]] kind = "kinematic"`.

    The mean relative poses are those of the body with the joint angles `mean_deg`, 0 where none is given. `relative` gives the pose of a part in its
    parent's frame itself: x, y, z in metres and a unit quaternion w, x, y, z. `sd_m` and `sd_deg` are standard deviations in the child's frame: one
    number, or one for each axis; by names of parts or patterns.
    """

    weight: Positive = 1.0
    """weight of the component; the weights are scaled to the sum 1."""
    mean_deg: Mapping[str, Finite] = {}
    """[degrees] table: a dof's name = its angle in the mean pose; 0 if it is not given."""
    relative: Mapping[str, tuple[Finite, Finite, Finite, Finite, Finite, Finite, Finite]] = {}
    """[metres, quaternion] table: a part's name = its mean pose in its parent's frame, `[x, y, z, qw, qx, qy, qz]`, which replaces that of
    `mean_deg`."""
    sd_m: Mapping[str, Width] = {"*": 0.02}
    """[metres] table: a part's name or a pattern = the standard deviation of its displacement, one number or one for each axis."""
    sd_deg: Mapping[str, Width] = {"*": 30.0}
    """[degrees] the same for its rotation vector."""


class Options(Schema):
    """Options of `[[potential]] kind = "kinematic"`: components with equal weights at every joint, or a learned file's name or path, or both.

    With both, `component_share` is the weight of the components. Broad ones let a joint move as it did not in what was learned from.
    """

    component: Annotated[tuple[Component, ...], Field(min_length=1)] = (Component(),)
    """tables `[[potential.component]]`, one or more."""
    learned: str | None = None
    """instead of components: the name of a file in `models/learned/`, such as `"kinematic_10"`, or the path of your own `.npz`."""
    component_share: Annotated[float, Field(gt=0, lt=1)] | None = None
    """with `learned` and components: the weight of the components beside the learned ones, between 0 and 1."""

    @model_validator(mode="after")
    def _check_share(self) -> "Options":
        has_both = self.learned is not None and "component" in self.model_fields_set
        if has_both and self.component_share is None:
            raise ValueError("both `learned` and `component`; expected one of the two, or both with `component_share`; add it.")
        if not has_both and self.component_share is not None:
            raise ValueError("`component_share` without both `learned` and `component`; expected both; add the other, or remove it.")
        return self


def log_density(edge: Mapping[str, Array], parent: Float[Array, "7"], child: Float[Array, "7"]) -> Scalar:
    """Return log g of one edge.

    Args:
        edge: the arrays of a mixture.
        parent: the pose of the parent.
        child: the pose of the child.
    """
    log_components = jnp.asarray(log_of_components(edge, rigid.relative(parent, child)))
    return log_components[0] if log_components.shape == (1,) else jax.nn.logsumexp(log_components)


def draw(key: Key, edge: Mapping[str, Array], neighbour: Float[Array, "7"], reverse: bool = False) -> Float[Array, "7"]:
    """Draw a child given its parent, or with `reverse` a parent given its child, from g. Rotations beyond a half turn are drawn again."""
    choice_key, step_key = jax.random.split(key)
    # The weights without the constants of the Gaussians.
    component = jax.random.categorical(choice_key, jnp.log(edge["weight"]))
    root = edge["root"][component]

    def too_far(state: tuple[Key, Array]) -> Array:
        return jnp.sum(state[1][1] ** 2) >= math.pi**2

    def redraw(state: tuple[Key, Array]) -> tuple[Key, Array]:
        next_key, use = jax.random.split(state[0])
        return next_key, jnp.asarray(times(root, jax.random.normal(use, (2, 3), root.dtype)))

    _, step = jax.lax.while_loop(too_far, redraw, (step_key, jnp.full((2, 3), jnp.inf, root.dtype)))
    return _stepped(edge["mean"][component], step, neighbour, reverse)


def weighted_draw(
    noise: Float[Array, "7"], edge: Mapping[str, Array], neighbour: Float[Array, "7"], reverse: bool = False
) -> tuple[Float[Array, "7"], Scalar]:
    """Return a draw as `draw` does, made from standard normal numbers, and its log-weight. A rotation beyond a half turn has the weight 0."""
    component = jnp.sum(jnp.cumsum(edge["weight"])[:-1] <= jax.scipy.special.ndtr(noise[0]))
    step = jnp.asarray(times(edge["root"][component], noise[1:].reshape(2, 3)))
    is_within = jnp.sum(step[1] ** 2) < math.pi**2
    return _stepped(edge["mean"][component], step, neighbour, reverse), jnp.where(is_within, -edge["log_mass"][component], -jnp.inf)


def _stepped(mean: Float[Array, "7"], step: Float[Array, "2 3"], neighbour: Float[Array, "7"], reverse: bool) -> Float[Array, "7"]:
    """Return the pose at a step (position, rotation vector) from the mean relative pose."""
    relative = rigid.compose(mean, rigid.rigid(step[0], rotations.exponential(step[1])))
    return jnp.asarray(rigid.compose(neighbour, rigid.inverse(relative) if reverse else relative))


def _stretched(edge: Mapping[str, Array], log_parent: Scalar, log_child: Scalar) -> dict[str, Array]:
    """Return the mixture with the joint where the parent's length puts it."""
    del log_child
    mean = edge["mean"]
    return {**edge, "mean": mean.at[:, :3].add((jnp.exp(log_parent) - 1) * edge["joint"])}


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
        InputError: the body is placed by angles; a name of a dof or part does not exist; a quaternion is not of length one; the learned file is
            malformed, or its joints are not those of the body.
    """
    require(body, PARTS, "potential 'kinematic'", "dynamics and limits of joint angles")
    placement = body.placement
    assert isinstance(placement, ByParts)
    rows = tuple((parent, child) for child, parent in enumerate(placement.parents) if parent >= 0)
    children = [child for _, child in rows]
    components = _components(name, options, body, children)
    parameters = {key: device_array(value, body.lengths.dtype) for key, value in mixture(*components).items()}
    functions: dict[str, Any] = {
        name: jax.tree_util.Partial(function) for name, function in (("draw", draw), ("weighted_draw", weighted_draw), ("pairwise", log_pairs))
    }
    parameters["joint"] = device_array(_means(name, Component(), body)[children, :3], body.lengths.dtype)
    resize = {LENGTHS: jax.tree_util.Partial(_stretched)}
    plate = Plate(PARTS, rows, jax.tree_util.Partial(log_density), parameters, **functions, resize=resize)
    return plate_factor(name, "prior", plate)


class _Joints(NamedTuple):
    """The components of each child's joint, as `mixture` takes them."""

    mean: Float[np.ndarray, "joint component 7"]
    covariance: Float[np.ndarray, "joint component 2 3 3"]
    weight: Float[np.ndarray, "joint component"]


def _components(name: str, options: Options, body: Body, children: list[int]) -> _Joints:
    """Return the components of the children's joints."""
    if options.learned is None:
        return _defined(name, options.component, body, children)
    learned, share = _learned(name, options.learned, body, children), options.component_share
    if share is None:
        return learned
    defined = _defined(name, options.component, body, children)
    weights = [
        proportion * joints.weight / joints.weight.sum(axis=-1, keepdims=True) for proportion, joints in ((1 - share, learned), (share, defined))
    ]
    mean, covariance = (np.concatenate(arrays, axis=1) for arrays in zip(learned[:2], defined[:2], strict=True))
    return _Joints(mean, covariance, np.concatenate(weights, axis=1))


def _defined(name: str, components: Sequence[Component], body: Body, children: list[int]) -> _Joints:
    """Return the components that the definition gives."""
    placement = body.placement
    assert isinstance(placement, ByParts)
    names = tuple(placement.names[child] for child in children)
    means = np.stack([_means(name, component, body)[children] for component in components], axis=1)
    widths = np.stack([widths_by_part(name, names, component.sd_m, component.sd_deg) for component in components], axis=1)
    covariances = widths.reshape(*widths.shape[:2], 2, 3, 1) ** 2 * np.eye(3)
    weights = np.broadcast_to([component.weight for component in components], widths.shape[:2])
    return _Joints(means, covariances, np.asarray(weights, float))


def _learned(name: str, file: str, body: Body, children: list[int]) -> _Joints:
    """Return the components from a learned file."""
    placement = body.placement
    assert isinstance(placement, ByParts)
    joints = load_joint_mixtures(file)
    body_joints = [(placement.names[child], placement.names[placement.parents[child]]) for child in children]
    learned = list(zip(joints.parts, joints.parents, strict=True))
    for part, parent in (*sorted(set(learned) - set(body_joints)), *sorted(set(body_joints) - set(learned))):
        without = f"the body '{body.name}' has" if (part, parent) in learned else "the file has"
        problem = f"learned on the body '{joints.body}', and {without} no joint of '{part}' with '{parent}'"
        remedy = "learn one with `bayes-body learn kinematic-potentials --body`"
        raise input_error(f"{name}: learned: {file}", problem, f"the joints of the body '{body.name}'", remedy)
    order = [learned.index(joint) for joint in body_joints]
    means = joints.mean[order]
    means[..., :3] += _means(name, Component(), body)[children, None, :3]
    means[..., 3:] = rotations.normalised(means[..., 3:])
    return _Joints(means, joints.covariance[order], joints.weight[order])


def _means(name: str, component: Component, body: Body) -> Float[np.ndarray, "part 7"]:
    """Return the mean pose of every part in its parent's frame."""
    placement = body.placement
    assert isinstance(placement, ByParts)
    for dof in component.mean_deg:
        if dof not in body.dof_names:
            raise InputError(f"{name}: mean_deg.{dof}: no dof of the body '{body.name}'; {nearest(dof, body.dof_names)}")
    pose = np.array([math.radians(component.mean_deg.get(dof, 0.0)) for dof in body.dof_names])
    parts = placement.configuration(body.skeleton, device_array(pose, body.lengths.dtype))
    relative = relative_to_parents(np.asarray(parts, float), placement.parents)
    for part, relative_pose in component.relative.items():
        if part not in placement.names:
            raise InputError(f"{name}: relative.{part}: no part of the body '{body.name}'; {nearest(part, placement.names)}")
        length = math.sqrt(sum(entry * entry for entry in relative_pose[3:]))
        if abs(length - 1) > 1e-3:
            problem, remedy = f"a quaternion of length {length:.4g}", "give w, x, y, z of a rotation, such as 1, 0, 0, 0"
            raise input_error(f"{name}: relative.{part}", problem, "length 1, or it is no rotation", remedy)
        relative[placement.names.index(part)] = (*relative_pose[:3], *(entry / length for entry in relative_pose[3:]))
    return relative
