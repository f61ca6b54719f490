"""Draws as an ArviZ DataTree: a chain is an independent run of the filter, a draw is a particle, and the weights are stored with the draws."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bayes_body.base.files.atomic import make_folder, replacing
from bayes_body.results.posterior.layout import attributes_of, coordinates, dims_of, groups
from bayes_body.tracking.draws import Draws

if TYPE_CHECKING:
    import xarray as xr


def to_datatree(draws: Draws, attributes: Mapping[str, Any] | None = None) -> "xr.DataTree":
    """Return the draws in ArviZ's form, all in memory.

    The coordinate `frame` has the numbers of the frames in the recording.

    Groups: `posterior` with the state's variables: `pose` (chain, draw, frame, dof), radians and metres as given by the `unit` coordinate, `parts`
    (chain, draw, frame, part, coordinate), others with the axes of their spaces; the attribute `space` says where a variable lives. `sample_stats`
    with `log_weight` and `ancestor` (chain, draw, frame); `filter` with `ess`, `log_evidence`, `lost` and `evaluations` (chain, frame), with
    `survival_rate`, `inverse_temperature` and `acceptance_rate` (chain, frame, layer), and with `seen` (frame, camera). If the kernel runs Markov
    chains, `filter` also has `markov_acceptance`, `markov_divergences`, `markov_energy_fraction` and `markov_step` (chain, frame, markov_chain),
    `markov_ess` (chain, frame, dof) and `markov_length` (chain, frame); their draws are stored one chain after the other.
    If it passes messages between the parts, `filter` also has the figures of `FilterInfo.messages`: `belief_ess`, `oscillation` (chain, frame, part),
    `message_ess`, `joint_ess`, `samples` (chain, frame), `message_change` (chain, frame, iteration, part), `belief_sd` (chain, frame, iteration,
    part, tangent) and `proposal_shares` (chain, frame, part, proposal).
    """
    import xarray as xr

    frames = list(draws.frames)
    datasets = {}
    for group, members in groups(draws).items():
        arrays = {variable.name: (variable.dims, variable.stack(frames), variable.attributes) for variable in members}
        datasets[group] = xr.Dataset(arrays, coordinates(draws, dims_of(members)))
    tree = xr.DataTree.from_dict(datasets)
    tree.attrs.update(attributes_of(draws, attributes))
    return tree


def save_posterior(tree: "xr.DataTree", path: Path) -> None:
    """Write the tree as NetCDF, either completely or not at all; `xarray.open_datatree` or `arviz.from_netcdf` reads it.

    Raises:
        InputError: the file system does not accept it.
    """
    make_folder(path.parent)
    # Encoded in memory, because HDF5 cannot handle a full disk.
    content = tree.to_netcdf(engine="h5netcdf")
    with replacing(path) as partial:
        partial.write_bytes(content)
