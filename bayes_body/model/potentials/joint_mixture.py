r"""A density of a relative pose Y: a Gaussian mixture in the tangent spaces at mean relative poses (Sigal et al. 2011, (6)).

$$g(Y) = \sum_m \delta_m\, \frac{\mathcal N(v_m; 0, \Sigma^v_m)\, \mathcal N(\omega_m; 0, \Sigma^\omega_m)}{P_m\, J(\omega_m)}, \qquad
\xi_m = (v_m, \omega_m) = \mathrm{Exp}^{-1}(\bar Y_m^{-1} Y).$$

The covariance is block-diagonal: a block for the position, in the axes of the mean child's frame, and one for the rotation vector.
$J = 2 (1 - \cos|\omega|) / |\omega|^2$ is the Jacobian of the exponential map. $P_m$ is the mass of the Gaussian within a half turn. g is therefore
normalised with respect to the Haar measure $dt\,dR$. It does not change under q → −q.

A mixture is a mapping of arrays: `mean` (component, 7); `root` (component, 2, 3, 3), lower-triangular, with $\Sigma = L L^T$ for each block;
`inverse_root`, its inverse; `weight` (component,); `log_weight` (component,), the log-weights with all constants of the Gaussians; `log_mass`
(component,), $\log P_m$.

`bayes-body learn kinematic-potentials` writes the learned densities of the joints of a body: an .npz that holds a mixture for each joint.

The log-potential of a joint is computed for all pairs of poses of parent and child at once, as products of matrices. With the reference position o, a
component's quadratic form separates into a part of the parent and a part of the child:

$$-\tfrac12\big[a(X_i) \cdot f(t_j - o) + s(|w|)^2\, g(X_i) \cdot h(q_j)\big] + 2 \log s(|w|) + \text{const}, \qquad
w = \langle q_i \bar q,\, q_j \rangle, \quad s = 2 \arccos |w| / \sqrt{1 - w^2}.$$

f are the 10 monomials of the position up to degree two and h the 10 products of the quaternion's entries, so three products of matrices (10, 10 and 4
columns) and two polynomials in 1 - |w| (base/geometry/rotations.py) give all pairs. This is over ten times as fast as pair by pair. In float32 the
error of log ψ is below 1e-3, if o is near the poses.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.stats import norm, qmc

from bayes_body.base.errors import input_error
from bayes_body.base.files.arrays_file import read_arrays
from bayes_body.base.files.atomic import replacing
from bayes_body.base.files.shipped import learned_file
from bayes_body.base.geometry import rigid, rotations
from bayes_body.base.geometry.namespaces import namespace

# Points of the quasi-random sum for the mass within a half turn: its error is below 1e-5.
POINTS = 2**15

type Numbers = Float[Array | np.ndarray, "..."]
type Mixture = Mapping[str, Any]


def mixture(
    mean: Float[np.ndarray, "*batch component 7"],
    covariance: Float[np.ndarray, "*batch component 2 3 3"],
    weight: Float[np.ndarray, "*batch component"],
) -> dict[str, np.ndarray]:
    """Return the arrays of a mixture, or of a batch of them.

    Args:
        mean: mean relative poses, metres and unit quaternions.
        covariance: of the position, metres², and of the rotation vector, radians²; positive definite.
        weight: positive; the weights of a mixture are scaled to the sum 1.
    """
    root = np.linalg.cholesky(covariance)
    weight = weight / weight.sum(axis=-1, keepdims=True)
    log_volume = np.log(np.diagonal(root, axis1=-2, axis2=-1)).sum(axis=(-2, -1))
    log_mass = np.log(within_half_turn(covariance[..., 1, :, :]))
    log_weight = np.log(weight) - log_volume - 3 * math.log(2 * math.pi) - log_mass
    return {"mean": mean, "root": root, "inverse_root": np.linalg.inv(root), "weight": weight, "log_weight": log_weight, "log_mass": log_mass}


def log_of_components(arrays: Mixture, relative: rigid.Rigid) -> Numbers:
    """Return the log-density of each component times its weight, (..., component).

    Args:
        arrays: a mixture, of JAX or of NumPy.
        relative: the pose of the child in its parent's frame, (..., 7).
    """
    xp = namespace(arrays["mean"], relative)
    steps = rigid.relative(arrays["mean"], relative[..., None, :])
    w = rotations.logarithm(steps[..., 3:])
    z = times(arrays["inverse_root"], xp.stack([steps[..., :3], w], axis=-2))
    return arrays["log_weight"] - 0.5 * xp.sum(z * z, axis=(-2, -1)) - rotations.log_jacobian(w)


def times(matrix: Numbers, vector: Numbers) -> Numbers:
    """Return the products of matrices (..., 3, 3) and vectors (..., 3), elementwise (see `geometry.transforms`)."""
    return sum((matrix[..., k] * vector[..., k : k + 1] for k in range(1, 3)), matrix[..., 0] * vector[..., :1])


def within_half_turn(covariance: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch"]:
    """Return the probability that a normal rotation vector with this covariance, radians², is shorter than π."""
    # The length of a vector does not depend on the axes: those of the covariance itself make its entries independent.
    variances = np.linalg.eigvalsh(covariance)
    return np.mean(variances @ _squares() < math.pi**2, axis=-1)


@cache
def _squares() -> Float[np.ndarray, "3 point"]:
    return norm.ppf(qmc.Sobol(3, scramble=True, rng=0).random(POINTS)).T ** 2


NUMBERS = ("mean", "covariance", "weight")
ARRAYS = ("body", "parts", "parents", *NUMBERS)
KIND, REMEDY = "a file of kinematic potentials", "make one with `bayes-body learn kinematic-potentials`"
# A quaternion or a covariance in single precision is off by less.
TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class JointMixtures:
    """A mixture for each joint, one joint for each part but the first (`potentials.joint_mixture`).

    Attributes:
        body: the name of the body.
        parts: the child of each joint.
        parents: the parent of each joint.
        mean: mean relative poses. Their positions, metres, are displacements in the parent's frame from where the joint is when all angles of the
            body are 0: so they fit a body of other lengths.
        covariance: of position, metres², and of rotation vector, radians².
        weight: weights of the components, of sum 1.
    """

    body: str
    parts: tuple[str, ...]
    parents: tuple[str, ...]
    mean: Float[np.ndarray, "joint component 7"]
    covariance: Float[np.ndarray, "joint component 2 3 3"]
    weight: Float[np.ndarray, "joint component"]


def save_joint_mixtures(joints: JointMixtures, path: Path) -> None:
    """Write the mixtures as an .npz with single precision.

    Raises:
        InputError: it cannot be written.
    """
    numbers: dict[str, Any] = {key: np.asarray(getattr(joints, key), np.float32) for key in NUMBERS}
    with replacing(path) as partial, partial.open("wb") as file:
        np.savez_compressed(file, body=np.array(joints.body), parts=np.array(joints.parts), parents=np.array(joints.parents), **numbers)


def load_joint_mixtures(name: str | Path) -> JointMixtures:
    """Read the mixtures: those that ship with the package, by name, or any by the path of their .npz.

    Raises:
        InputError: the file does not exist or is malformed; a quaternion is no rotation, or a matrix no covariance.
    """
    path = learned_file(name)
    arrays = read_arrays(path, ARRAYS, KIND, REMEDY)
    try:
        texts = {key: [str(text) for text in arrays[key]] for key in ("parts", "parents")}
        numbers = {key: arrays[key].astype(float) for key in NUMBERS}
        joints = JointMixtures(str(arrays["body"]), tuple(texts["parts"]), tuple(texts["parents"]), **numbers)
        count, components = joints.weight.shape
        shapes = [(count, components, 7), (count, components, 2, 3, 3), (len(joints.parts), components), (len(joints.parents), components)]
        if shapes != [joints.mean.shape, joints.covariance.shape, joints.weight.shape, joints.weight.shape] or not joints.weight.size:
            raise ValueError
    # Outside tests nothing checks shapes when a dataclass is made; inside, it is a TypeError.
    except (ValueError, KeyError, TypeError) as error:
        raise input_error(path, f"other arrays ({type(error).__name__})", KIND, REMEDY) from None
    _check_numbers(joints, path)
    return joints


def _check_numbers(joints: JointMixtures, path: Path) -> None:
    lengths = np.linalg.norm(joints.mean[..., 3:], axis=-1)
    blocks = np.nan_to_num(joints.covariance, nan=-1.0, posinf=-1.0, neginf=-1.0)
    symmetric = np.abs(blocks - np.swapaxes(blocks, -1, -2)).max(axis=(-3, -2, -1)) <= TOLERANCE * np.abs(blocks).max(axis=(-3, -2, -1))
    proper = (np.linalg.eigvalsh(blocks).min(axis=(-2, -1)) > 0) & symmetric
    for j, part in enumerate(joints.parts):
        for m in range(joints.weight.shape[1]):
            subject = f"{path}: {part}, component {m + 1}"
            if not np.isfinite(joints.mean[j, m]).all() or not abs(lengths[j, m] - 1) <= TOLERANCE:
                raise input_error(subject, f"a quaternion of length {lengths[j, m]:.4g}", "length 1, or it is no rotation", REMEDY)
            if not proper[j, m]:
                raise input_error(subject, "a matrix that is no covariance", "symmetric and positive definite blocks", REMEDY)
            if not 0 < joints.weight[j, m] < np.inf:
                raise input_error(subject, f"the weight {joints.weight[j, m]:g}", "a finite number above 0", REMEDY)


UPPER3, UPPER4 = np.triu_indices(3), np.triu_indices(4)


def log_pairs(edge: Mapping[str, Array], parents: Float[Array, "parent 7"], children: Float[Array, "child 7"]) -> Float[Array, "parent child"]:
    """Return the log-density of a joint's mixture (`potentials.joint_mixture`) for all pairs of poses.

    Args:
        edge: the arrays of the mixture.
        parents: poses of the parent.
        children: poses of the child.
    """
    origin = jnp.mean(children[:, :3], axis=0)
    t, q = children[:, :3] - origin, children[:, 3:]
    f = jnp.concatenate([t[:, UPPER3[0]] * t[:, UPPER3[1]], t, jnp.ones_like(t[:, :1])], axis=1)
    h = q[:, UPPER4[0]] * q[:, UPPER4[1]]

    def of_component(mean: Array, root: Array, log_weight: Array) -> Array:
        a, g, turned = _of_parents(mean, root, parents, origin)
        versine = rotations.away(turned, q)
        quadratic = a @ f.T + rotations.squared(versine) * (g @ h.T)
        # The Jacobian of the exponential map is (2 / s)².
        return log_weight - 2 * np.log(2) - 0.5 * quadratic + rotations.log_squared(versine)

    log_components = jax.vmap(of_component)(edge["mean"], edge["inverse_root"], edge["log_weight"])
    return log_components[0] if len(log_components) == 1 else jax.nn.logsumexp(log_components, axis=0)


def _of_parents(
    mean: Float[Array, "7"], root: Float[Array, "2 3 3"], parents: Float[Array, "parent 7"], origin: Float[Array, "3"]
) -> tuple[Float[Array, "parent 10"], Float[Array, "parent 10"], Float[Array, "parent 4"]]:
    """Return the parents' coefficients of f and h, and the mean rotations of their children."""
    turned = jnp.asarray(rotations.multiply(parents[:, 3:], mean[None, 3:]))
    centre = parents[:, :3] - origin + jnp.asarray(rotations.rotate(parents[:, 3:], mean[None, :3]))
    whiten = root[0] @ jnp.swapaxes(jnp.asarray(rotations.to_matrix(turned)), 1, 2)
    precision = jnp.swapaxes(whiten, 1, 2) @ whiten
    linear = jnp.einsum("nij,nj->ni", precision, centre)
    a = jnp.concatenate([_folded(precision, UPPER3), -2 * linear, jnp.sum(linear * centre, axis=1, keepdims=True)], axis=1)
    # The vector part of the conjugate mean times q, as a matrix (3, 4) times q.
    units = jnp.eye(4, dtype=parents.dtype)
    columns = jnp.asarray(rotations.multiply(rotations.conjugate(turned)[:, None], units[None]))[..., 1:]
    vectors = jnp.einsum("ij,nkj->nik", root[1], columns)
    return a, _folded(jnp.einsum("nik,nil->nkl", vectors, vectors), UPPER4), turned


def _folded(matrices: Float[Array, "parent n n"], upper: tuple[np.ndarray, np.ndarray]) -> Float[Array, "parent entry"]:
    """Return the entries on and above the diagonal; those above count twice."""
    rows, columns = upper
    return matrices[:, rows, columns] * np.where(rows == columns, 1.0, 2.0).astype(matrices.dtype)
