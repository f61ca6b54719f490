"""An activity, learned from captured motion (Darby et al. 2008, 4 and 5).

Its joint angles are near a linear subspace, and a hidden Markov model says how they move through it. `bayes-body learn activity-hmm` writes it as an
.npz, and the motion prior `activity_hmm` reads it.
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

NAME = "walking_hmm"
TEXTS = ("body", "names", "subjects", "labels")
NUMBERS = (
    *("means", "between", "centre", "basis", "residual", "initial", "transition", "locations", "covariances"),
    *("change", "low", "high", "kept", "fps"),
)
KIND, REMEDY = "an activity", "make one with `bayes-body learn activity-hmm`"
# Rows of probabilities sum to 1 up to this, in single precision.
ROUNDING = 1e-4


@dataclass(frozen=True, eq=False)
class Activity:
    r"""An activity in joint angles, radians. A pose is $m + \bar\epsilon + \Phi f$ plus a residual, with the features f emitted by the states.

    Attributes:
        body: the name of the body.
        names: its dofs that are learned. The others (position, orientation, head) are free.
        subjects: the people that it was learned from.
        labels: for each state, the activity that it belongs to.
        means: m, the mean pose of each subject.
        between: standard deviation between the subjects' means; 0 for a single subject.
        centre: $\bar\epsilon$, the mean of the poses after the subjects' means are removed.
        basis: $\Phi$, orthonormal columns.
        residual: standard deviation of what the features leave, within a subject.
        initial: the probability of each state at the start of a sequence.
        transition: the probability of each state after each state, one frame later.
        locations: $\mu$, the mean features of each state.
        covariances: $\Sigma$ of each state.
        change: for every dof of the body, half the largest change between two frames in training, radians and metres.
        low: the smallest angle in training, of each learned dof.
        high: the largest.
        kept: the fraction of the variance that the features keep.
        fps: frames per second.
    """

    body: str
    names: tuple[str, ...]
    subjects: tuple[str, ...]
    labels: tuple[str, ...]
    means: Float[np.ndarray, "subject dof"]
    between: Float[np.ndarray, " dof"]
    centre: Float[np.ndarray, " dof"]
    basis: Float[np.ndarray, "dof feature"]
    residual: Float[np.ndarray, " dof"]
    initial: Float[np.ndarray, " state"]
    transition: Float[np.ndarray, "state state"]
    locations: Float[np.ndarray, "state feature"]
    covariances: Float[np.ndarray, "state feature feature"]
    change: Float[np.ndarray, " body_dof"]
    low: Float[np.ndarray, " dof"]
    high: Float[np.ndarray, " dof"]
    kept: float
    fps: float


def save_activity(activity: Activity, path: Path) -> None:
    """Write an activity as an .npz with single precision.

    Raises:
        InputError: it cannot be written.
    """
    numbers: dict[str, Any] = {key: np.asarray(getattr(activity, key), np.float32) for key in NUMBERS}
    with replacing(path) as partial, partial.open("wb") as file:
        np.savez_compressed(file, **{key: np.array(getattr(activity, key)) for key in TEXTS}, **numbers)


def load_activity(name: str | Path = NAME) -> Activity:
    """Read an activity: one that ships with the package, by name, or any by the path of its .npz.

    Raises:
        InputError: the file does not exist or is malformed.
    """
    path = learned_file(name)
    arrays = read_arrays(path, (*TEXTS, *NUMBERS), KIND, REMEDY)
    try:
        return _checked(arrays)
    except (ValueError, KeyError, IndexError, np.linalg.LinAlgError) as error:
        raise input_error(path, f"other arrays ({type(error).__name__})", KIND, REMEDY) from None


def _checked(arrays: Mapping[str, np.ndarray]) -> Activity:
    names, subjects, labels = (tuple(str(name) for name in arrays[key]) for key in ("names", "subjects", "labels"))
    numbers = {key: arrays[key].astype(float) for key in NUMBERS}
    dofs, features, states = len(names), numbers["basis"].shape[1], len(labels)
    shapes = {
        "means": (len(subjects), dofs),
        "basis": (dofs, features),
        "transition": (states, states),
        "locations": (states, features),
        "covariances": (states, features, features),
        "initial": (states,),
        "kept": (),
        "fps": (),
        **dict.fromkeys(("between", "centre", "residual", "low", "high"), (dofs,)),
        "change": (len(numbers["change"]),),
    }
    wrong = any(numbers[key].shape != shape or not np.isfinite(numbers[key]).all() for key, shape in shapes.items())
    rows = np.concatenate([numbers["transition"], numbers["initial"][None]])
    if wrong or not names or not subjects or not states or (rows < 0).any() or (abs(rows.sum(axis=1) - 1) > ROUNDING).any() or numbers["fps"] <= 0:
        raise ValueError
    np.linalg.cholesky(numbers["covariances"])
    kept_variance, fps = float(numbers.pop("kept")), float(numbers.pop("fps"))
    return Activity(str(arrays["body"]), names, subjects, labels, **numbers, kept=kept_variance, fps=fps)
