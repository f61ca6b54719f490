r"""A walking cycle in joint angles (Sidenbladh, Black & Fleet 2000, 5).

$$s(\varphi) = \bar s(\varphi) + \sum_k c_k\, m_k(\varphi), \qquad c_k \sim N(0, 1).$$

The mean and the modes are Fourier series of the phase $\varphi$, in cycles. `bayes-body learn walking-angles` learns them from captured walks.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import input_error
from bayes_body.base.files.arrays_file import read_arrays
from bayes_body.base.files.atomic import replacing
from bayes_body.base.files.shipped import learned_file

NAME = "walking_angles"
ARRAYS = ("body", "names", "mean", "modes", "pace", "pace_modes", "residual", "explained")
KIND, REMEDY = "a walking cycle in joint angles", "make one with `bayes-body learn walking-angles`"


@dataclass(frozen=True, eq=False)
class AngleCycle:
    r"""Strides of several walkers as joint angles, radians.

    Attributes:
        body: the name of the body.
        names: its dofs, without the six of the root.
        mean: Fourier terms: the constant, the cosines, the sines.
        modes: Fourier terms of each mode, for one standard deviation.
        pace: logarithms of the mean stride's duration, in units of $\sqrt{\ell / g}$, and of its length, in units of the leg's length $\ell$.
        pace_modes: change of `pace` by each mode.
        residual: standard deviation of what the modes leave, for a walker who was not among those that they were learned from.
        explained: the fraction of the strides' variance that the modes explain.
    """

    body: str
    names: tuple[str, ...]
    mean: Float[np.ndarray, "term dof"]
    modes: Float[np.ndarray, "mode term dof"]
    pace: Float[np.ndarray, "2"]
    pace_modes: Float[np.ndarray, "mode 2"]
    residual: Float[np.ndarray, " dof"]
    explained: float


def save_angle_cycle(cycle: AngleCycle, path: Path) -> None:
    """Write a cycle as an .npz with single precision.

    Raises:
        InputError: it cannot be written.
    """
    numbers: dict[str, Any] = {key: np.asarray(getattr(cycle, key), np.float32) for key in ARRAYS[2:]}
    with replacing(path) as partial, partial.open("wb") as file:
        np.savez_compressed(file, body=np.array(cycle.body), names=np.array(cycle.names), **numbers)


def load_angle_cycle(name: str | Path = NAME) -> AngleCycle:
    """Read a cycle: one that ships with the package, by name, or any by the path of its .npz.

    Raises:
        InputError: the file does not exist or is malformed.
    """
    path = learned_file(name)
    arrays = read_arrays(path, ARRAYS, KIND, REMEDY)
    try:
        return _checked(arrays)
    except (ValueError, KeyError) as error:
        raise input_error(path, f"other arrays ({type(error).__name__})", KIND, REMEDY) from None


def _checked(arrays: Mapping[str, np.ndarray]) -> AngleCycle:
    names = tuple(str(name) for name in arrays["names"])
    numbers = {key: arrays[key].astype(float) for key in ARRAYS[2:]}
    (terms, dofs), count = numbers["mean"].shape, len(numbers["modes"])
    shapes = {
        "mean": (terms, len(names)),
        "modes": (count, terms, dofs),
        "pace": (2,),
        "pace_modes": (count, 2),
        "residual": (dofs,),
        "explained": (),
    }
    if not terms % 2 or not count or any(numbers[key].shape != shape or not np.isfinite(numbers[key]).all() for key, shape in shapes.items()):
        raise ValueError
    explained = float(numbers.pop("explained"))
    return AngleCycle(str(arrays["body"]), names, **numbers, explained=explained)
