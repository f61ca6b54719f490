r"""Draws as an ArviZ DataTree, and diagnostics that respect weights.

A chain is an independent run of the filter, a draw a particle. `posterior` holds the particles as they are, `sample_stats` their `log_weight` and
`ancestor`; nothing in ArviZ takes weights, so what ArviZ computes (R-hat) is computed on equal-weight draws made from them by resampling.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bayes_body.errors import wrong
from bayes_body.files import make_folder
from bayes_body.model import Model
from bayes_body.tracking import Draws

if TYPE_CHECKING:
    import xarray as xr

# Equal-weight draws are a matter of the posterior, not of the sampler: their seed is fixed, so that a saved run always gives the same figures.
RESAMPLING_SEED = 0


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
    by_frame = {"ess": info.ess, "log_evidence": info.log_evidence, "lost": info.lost}
    by_layer = {"survival_rate": info.survival_rate, "inverse_temperature": info.inverse_temperatures}
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


def mean_poses(draws: Draws) -> Float[np.ndarray, "run frame dof"]:
    """The weighted posterior mean of each run and frame, radians and metres."""
    weights = np.exp(draws.log_weights - draws.log_weights.max(axis=-1, keepdims=True))
    weights /= weights.sum(axis=-1, keepdims=True)
    return np.einsum("rfp,rfpd->rfd", weights, draws.states["pose"])


def markers(model: Model, poses: Float[np.ndarray, "*batch dof"]) -> Float[np.ndarray, "*batch marker 3"]:
    """The 15 virtual markers of any array of poses, metres, computed when asked for."""
    flat = jnp.asarray(poses.reshape(-1, poses.shape[-1]))
    positions = np.asarray(jax.jit(jax.vmap(model.markers))(flat))
    return positions.reshape(*poses.shape[:-1], *positions.shape[1:])


def equal_weight_draws(draws: Draws, count: int | None = None, seed: int = RESAMPLING_SEED) -> Float[np.ndarray, "run frame draw dof"]:
    """Draws of equal weight, by systematic resampling in random order; as many as there are particles, or `count`."""
    rng = np.random.default_rng(seed)
    runs, frames, particles = draws.log_weights.shape
    number = particles if count is None else count
    out = np.empty((runs, frames, number, draws.states["pose"].shape[-1]), draws.states["pose"].dtype)
    for run in range(runs):
        for frame in range(frames):
            log_weights = draws.log_weights[run, frame].astype(float)
            cumulative = np.cumsum(np.exp(log_weights - log_weights.max()))
            places = (np.arange(number) + rng.random()) / number * cumulative[-1]
            chosen = np.minimum(np.searchsorted(cumulative, places), particles - 1)
            out[run, frame] = draws.states["pose"][run, frame, rng.permutation(chosen)]
    return out


def rhat(draws: Draws) -> Float[np.ndarray, "frame dof"]:
    """Rank-normalised split R-hat over the runs (Vehtari et al. 2021); NaN with a single run. A dof that never moves has none either."""
    import arviz as az
    import xarray as xr

    sample = equal_weight_draws(draws)
    if sample.shape[0] < 2:
        return np.full(sample.shape[1:2] + sample.shape[-1:], np.nan)
    array = xr.DataArray(np.swapaxes(sample, 1, 2), dims=("chain", "draw", "frame", "dof"), name="pose")
    return np.asarray(az.rhat(array.to_dataset())["pose"])
