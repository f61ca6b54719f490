r"""A constraint: no joint angle beyond those of the training motions (Darby, Li & Costen 2008, 6.1).

$$\log C = -\infty \text{ if any learned angle is below } \mathrm{low} - m \text{ or above } \mathrm{high} + m,$$

with the ranges in a file of `bayes-body learn activity-hmm`. For a person who was among those that it was learned from; others move differently.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from bayes_body.base.errors import input_error
from bayes_body.base.files.arrays_file import read_arrays
from bayes_body.base.files.shipped import learned_file
from bayes_body.base.registry import register
from bayes_body.base.shapes import Scalar
from bayes_body.base.toml.schema import NonNegative, Schema
from bayes_body.density.factor import Factor, Variable, Variables
from bayes_body.model.body.placed_body import require
from bayes_body.model.body.placement import POSE
from bayes_body.model.body.solids import Body

REMEDY = "make one with `bayes-body learn activity-hmm`"


class Options(Schema):
    """Options of `[[constraint]] kind = "training_limits"`: a name in `models/learned/` or the path of an .npz, and what may be exceeded."""

    activity: str
    """a name in `models/learned/`, or the path of an `.npz` of `bayes-body learn activity-hmm`."""
    margin_deg: NonNegative = 0.0
    """[degrees] by how much a range may be exceeded."""


def _potential(dofs: Int[Array, " dof"], low: Float[Array, " dof"], high: Float[Array, " dof"], values: Variables, data: None) -> Scalar:
    del data
    # A step has no gradient, so do not trace one.
    angles = jax.lax.stop_gradient(values[Variable(POSE)])[dofs]
    return jnp.where(jnp.all((angles >= low) & (angles <= high)), 0.0, -jnp.inf)


@register("potential", "training_limits", Options)
def build(name: str, options: Options, body: Body, **_: Any) -> Factor:
    """Build the factor for one body.

    Raises:
        InputError: the file cannot be read, or the body lacks one of its dofs.
    """
    require(body, POSE, "constraint 'training_limits'", "another constraint")
    path = learned_file(options.activity)
    arrays = read_arrays(path, ("names", "low", "high"), "ranges of joint angles", REMEDY)
    names = tuple(str(dof) for dof in arrays.get("names", ()))
    missing = [dof for dof in names if dof not in body.dof_names]
    if missing or not names or not len(names) == len(arrays.get("low", ())) == len(arrays.get("high", ())):
        problem = f"ranges of {len(names)} dofs" + (f", one of them {missing[0]}" if missing else "")
        raise input_error(path, problem, f"ranges of dofs of the body '{body.name}'", REMEDY)
    dofs = np.array([body.dof_names.index(dof) for dof in names])
    margin, dtype = np.radians(options.margin_deg), body.lengths.dtype
    low, high = (jnp.asarray(arrays[side] + sign * margin, dtype) for side, sign in (("low", -1), ("high", 1)))
    return Factor(
        name=name,
        side="constraint",
        scope=(Variable(POSE),),
        log_potential=jax.tree_util.Partial(_potential, jnp.asarray(dofs), low, high),
    )
