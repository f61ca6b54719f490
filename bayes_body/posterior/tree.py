"""Draws as an ArviZ DataTree: a chain is an independent run of the filter, a draw is a particle, and weights are kept beside the draws."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bayes_body.errors import wrong
from bayes_body.files import make_folder
from bayes_body.tracking import Draws

if TYPE_CHECKING:
    import xarray as xr


def to_datatree(draws: Draws, attributes: Mapping[str, Any] | None = None) -> "xr.DataTree":
    """The draws in ArviZ's form.

    Groups: `posterior` (chain, draw, frame, dof), radians and metres as the `unit` coordinate says; `sample_stats` with `log_weight` and `ancestor`
    (chain, draw, frame); `filter` with one value a frame (chain, frame), of `survival_rate` and `inverse_temperature` one a layer.
    """
    import arviz as az

    topology = draws.model.body.skeleton.topology
    states = {name: np.swapaxes(values, 1, 2) for name, values in draws.states.items()}
    stats = {"log_weight": np.swapaxes(draws.log_weights, 1, 2), "ancestor": np.swapaxes(np.asarray(draws.info.ancestors), 1, 2)}
    tree = az.from_dict(
        {"posterior": states, "sample_stats": stats},
        coords={"frame": np.arange(draws.log_weights.shape[1]), "dof": list(topology.dof_names)},
        dims={"pose": ["frame", "dof"], "log_weight": ["frame"], "ancestor": ["frame"]},
    )
    tree["posterior"] = tree["posterior"].to_dataset().assign_coords(unit=("dof", list(topology.dof_units)))
    tree["filter"] = _filter_group(draws)
    tree.attrs.update({"model": draws.model.definition.name})
    tree.attrs.update(attributes or {})
    return tree


def _filter_group(draws: Draws) -> "xr.Dataset":
    import xarray as xr

    info = draws.info
    by_frame = {"ess": info.ess, "log_evidence": info.log_evidence, "lost": info.lost, "evaluations": info.evaluations}
    by_layer = {"survival_rate": info.survival_rate, "inverse_temperature": info.inverse_temperatures, "acceptance_rate": info.acceptance_rate}
    variables = {name: (("chain", "frame"), np.asarray(value)) for name, value in by_frame.items()}
    variables |= {name: (("chain", "frame", "layer"), np.asarray(value)) for name, value in by_layer.items()}
    runs, frames, layers = np.shape(info.survival_rate)
    return xr.Dataset(variables, {"chain": np.arange(runs), "frame": np.arange(frames), "layer": np.arange(layers)})


def save_posterior(tree: "xr.DataTree", path: Path) -> None:
    """Write the tree as NetCDF; `xarray.open_datatree` or `arviz.from_netcdf` reads it."""
    make_folder(path.parent)
    try:
        tree.to_netcdf(path, engine="h5netcdf")
    except OSError as error:
        raise wrong(path, f"cannot be written ({error.strerror or error})", "a folder with room", "free some space or name another folder") from None
