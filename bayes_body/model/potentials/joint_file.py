"""Learned densities of the joints of a body, as `bayes-body learn kinematic-potentials` writes them: an .npz that holds a mixture for each joint."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import input_error
from bayes_body.base.files.arrays_file import read_arrays
from bayes_body.base.files.atomic import replacing
from bayes_body.base.files.shipped import learned_file

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
            where = f"{path}: {part}, component {m + 1}"
            if not np.isfinite(joints.mean[j, m]).all() or not abs(lengths[j, m] - 1) <= TOLERANCE:
                raise input_error(where, f"a quaternion of length {lengths[j, m]:.4g}", "length 1, or it is no rotation", REMEDY)
            if not proper[j, m]:
                raise input_error(where, "a matrix that is no covariance", "symmetric and positive definite blocks", REMEDY)
            if not 0 < joints.weight[j, m] < np.inf:
                raise input_error(where, f"the weight {joints.weight[j, m]:g}", "a finite number above 0", REMEDY)
