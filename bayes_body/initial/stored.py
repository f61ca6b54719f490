"""A first pose as a run stores it. It is fitted once; a run that is continued or read uses the same bits."""

from collections.abc import Mapping
from itertools import chain
from typing import Any

import jax.numpy as jnp
import numpy as np

from bayes_body.errors import input_error
from bayes_body.initial.report import FirstPose
from bayes_body.model.build import Model


def stored(model: Model, found: FirstPose) -> dict[str, Any]:
    """The pose by dof (radians and metres) and the fitted lengths and outline, as a table."""
    pose = dict(zip(model.body.dof_names, np.asarray(found.pose, float).tolist(), strict=True))
    radii = {part: list(ends) for part, ends in found.outline_radii_m.items()}
    return {"pose": pose} | ({"lengths_m": dict(found.lengths_m)} if found.lengths_m else {}) | ({"outline_radii_m": radii} if radii else {})


def restored(model: Model, table: Mapping[str, Any], where: str) -> FirstPose:
    """The first pose in a table.

    Args:
        model: whose body it is a pose of.
        table: from `stored`.
        where: the table's name in error messages.

    Raises:
        InputError: the pose is another body's, or an entry is no number.
    """
    pose, lengths, radii = table.get("pose"), table.get("lengths_m", {}), table.get("outline_radii_m", {})
    if not isinstance(pose, dict) or set(pose) != set(model.body.dof_names):
        raise input_error(f"{where}: pose", "of other dofs", f"a number for each dof of the body '{model.body.name}'", "begin the run anew")
    if not isinstance(lengths, dict) or not isinstance(radii, dict) or not all(isinstance(ends, list) and len(ends) == 2 for ends in radii.values()):
        raise input_error(where, "lengths or radii that are not numbers", "a number for each length, two for each part", "begin the run anew")
    if not all(isinstance(value, float) for value in (*pose.values(), *lengths.values(), *chain.from_iterable(radii.values()))):
        raise input_error(where, "not all of it numbers", "radians and metres", "begin the run anew")
    placed = jnp.asarray([pose[name] for name in model.body.dof_names], model.body.lengths.dtype)
    return FirstPose(placed, lengths_m=lengths, outline_radii_m={part: (base, tip) for part, (base, tip) in radii.items()})
