"""A first pose as a run keeps it: fitted once, then the same to the last bit whoever continues or reads the run."""

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from bayes_body.errors import wrong
from bayes_body.initial.report import FirstPose
from bayes_body.model import Model


def stored(model: Model, found: FirstPose) -> dict[str, Any]:
    """The pose by dof (radians and metres) and the fitted lengths, as a table."""
    pose = dict(zip(model.body.dof_names, np.asarray(found.pose, float).tolist(), strict=True))
    return {"pose": pose} | ({"lengths_m": dict(found.lengths_m)} if found.lengths_m else {})


def restored(model: Model, table: Mapping[str, Any], where: str) -> FirstPose:
    """The first pose that a table holds.

    Args:
        model: whose body it is a pose of.
        table: from `stored`.
        where: what sentences shall call it.

    Raises:
        InputError: it is of another body, or holds no numbers.
    """
    pose, lengths = table.get("pose"), table.get("lengths_m", {})
    if not isinstance(pose, dict) or set(pose) != set(model.body.dof_names):
        raise wrong(f"{where}: pose", "of other dofs", f"a number for each dof of the body '{model.body.name}'", "begin the run anew")
    if not isinstance(lengths, dict) or not all(isinstance(value, float) for value in (*pose.values(), *lengths.values())):
        raise wrong(f"{where}", "not all of it numbers", "radians and metres", "begin the run anew")
    return FirstPose(jnp.asarray([pose[name] for name in model.body.dof_names], model.body.lengths.dtype), lengths_m=lengths)
