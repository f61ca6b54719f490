"""The first pose as stored in a run. It is fitted once; a run that is continued or loaded uses exactly the same numbers."""

from collections.abc import Mapping
from itertools import chain
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import input_error
from bayes_body.initial.fitting.report import FirstPose
from bayes_body.model.build import Model

# Decimals of the draws, radians and metres. Draws are rounded when they are found, so that a run that is continued has the same ones.
DIGITS = 5


def stored(model: Model, estimate: FirstPose) -> dict[str, Any]:
    """Return a table of the pose by dof (radians and metres), the equally likely poses by draw, and the fitted lengths and outline."""
    pose = dict(zip(model.body.dof_names, np.asarray(estimate.pose, float).tolist(), strict=True))
    radii = {part: list(ends) for part, ends in estimate.outline_radii_m.items()}
    draws = {} if estimate.draws is None else {"draws": np.asarray(estimate.draws, float).round(DIGITS).tolist()}
    return (
        {"pose": pose}
        | draws
        | ({"lengths_m": dict(estimate.lengths_m)} if estimate.lengths_m else {})
        | ({"outline_radii_m": radii} if radii else {})
    )


def restored(model: Model, table: Mapping[str, Any], table_name: str) -> FirstPose:
    """Return the first pose from a table.

    Args:
        model: the model to whose body the pose belongs.
        table: a table written by `stored`.
        table_name: the table's name in error messages.

    Raises:
        InputError: the pose belongs to another body, or an entry is not a number.
    """
    pose, lengths, radii = table.get("pose"), table.get("lengths_m", {}), table.get("outline_radii_m", {})
    if not isinstance(pose, dict) or set(pose) != set(model.body.dof_names):
        raise input_error(f"{table_name}: pose", "dofs of another body", f"a number for each dof of the body '{model.body.name}'", "start a new run")
    if not isinstance(lengths, dict) or not isinstance(radii, dict) or not all(isinstance(ends, list) and len(ends) == 2 for ends in radii.values()):
        raise input_error(table_name, "lengths or radii that are not numbers", "a number for each length, two for each part", "start a new run")
    if not all(isinstance(value, float) for value in (*pose.values(), *lengths.values(), *chain.from_iterable(radii.values()))):
        raise input_error(table_name, "some values are not numbers", "radians and metres", "start a new run")
    dtype = model.body.lengths.dtype
    placed = jnp.asarray([pose[name] for name in model.body.dof_names], dtype)
    draws = None if "draws" not in table else _draws(table["draws"], len(pose), table_name)
    of_parts = {part: (base, tip) for part, (base, tip) in radii.items()}
    return FirstPose(placed, "stored", lengths_m=lengths, outline_radii_m=of_parts, draws=None if draws is None else jnp.asarray(draws, dtype))


def _draws(rows: Any, dofs: int, table_name: str) -> Float[np.ndarray, "draw dof"]:
    is_table = isinstance(rows, list) and bool(rows) and all(isinstance(row, list) and len(row) == dofs for row in rows)
    if not is_table or not all(isinstance(value, float) for row in rows for value in row):
        raise input_error(f"{table_name}: draws", "no poses", f"rows of {dofs} numbers, radians and metres", "start a new run")
    return np.array(rows, float)
