"""The spaces of a stored posterior's variables, and which of them the diagnostics read."""

from typing import TYPE_CHECKING

import numpy as np

from bayes_body.base.errors import input_error
from bayes_body.density.spaces import Space, euclidean, numbered, space_from_text

if TYPE_CHECKING:
    import xarray as xr

# Name of the attribute with a variable's space.
SPACE = "space"
# End of the names of variables that only repeat the frame before.
BEFORE = "_before"


def stored_spaces(tree: "xr.DataTree") -> dict[str, Space]:
    """Return the spaces of the variables that diagnostics read: of `pose` where there is one, else of all variables that do not repeat another frame.

    A posterior without spaces, as older versions wrote it, has plain numbers, with the names and units of its dofs.

    Raises:
        InputError: a space cannot be read.
    """
    group = tree["posterior"].to_dataset()
    names = ["pose"] if "pose" in group else [str(name) for name in group.data_vars if not str(name).endswith(BEFORE)]
    return {name: _space(name, group[name]) for name in names}


def _space(name: str, values: "xr.DataArray") -> Space:
    if SPACE in values.attrs:
        try:
            return space_from_text(str(values.attrs[SPACE]))
        except ValueError as error:
            problem, expected = str(error), "the space of a variable, as this version writes it"
            raise input_error(f"the posterior's variable '{name}'", problem, expected, "read it with the version that wrote it") from None
    dims = [dim for dim in values.dims if dim not in ("chain", "draw", "frame")]
    if len(dims) != 1 or dims[0] not in values.coords:
        return numbered(name, tuple(values.sizes[dim] for dim in dims))
    labels = tuple(np.asarray(values[dims[0]]).astype(str).tolist())
    units = tuple(np.asarray(values["unit"]).astype(str).tolist()) if dims[0] == "dof" and "unit" in values.coords else ("",) * len(labels)
    return euclidean(labels, units, str(dims[0]))
