"""Convert draws to an ArviZ DataTree, and write it as `posterior.nc` frame by frame in bounded memory, for xarray and ArviZ.

The groups `posterior` and `sample_stats` are stored in chunks: all draws of one run in some frames. The group `filter` has a few numbers per frame,
and each of its variables is stored in one chunk, or of a long recording in chunks of a megabyte. All chunks have checksums, which HDF5 verifies when
it reads them. The file depends neither on when it was written nor on how often the run was resumed.

In the tree, a chain is an independent run of the filter, a draw is a particle, and the weights are stored with the draws. `tree_on_demand` reads the
arrays from the frames when they are needed, so that memory does not grow with the number of frames.
"""

import math
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bayes_body.base.errors import input_error
from bayes_body.base.files.atomic import ErrorDeferringFile, make_folder, replacing
from bayes_body.base.progress import Watch, unwatched
from bayes_body.results.posterior.layout import Variable, attributes_of, coordinates, dims_of, groups, sizes, unit_name
from bayes_body.tracking.draws import Draws, FrameResult, Frames

if TYPE_CHECKING:
    import h5netcdf
    import xarray as xr

# Size of a chunk in bytes, and the largest number of frames in it.
CHUNK_BYTES, CHUNK_FRAMES = 2**20, 256
IN_CHUNKS = ("posterior", "sample_stats")


def stream_posterior(draws: Draws, path: Path, attributes: Mapping[str, Any] | None = None, watch: Watch = unwatched) -> None:
    """Write the tree of `to_datatree(draws, attributes)` as NetCDF, either completely or not at all. `watch` draws a progress bar.

    Raises:
        InputError: the disk is full, the file system does not accept the file, or a frame's file is damaged.
    """
    import h5netcdf

    make_folder(path.parent)
    _check_room(draws, path)
    count, step = len(draws.frames), frames_in_chunk(draws)
    with replacing(path) as partial, ErrorDeferringFile(partial) as steady:
        with h5netcdf.File(steady, "w") as file:
            file.attrs.update(attributes_of(draws, attributes))
            arrays = [array for name, members in groups(draws).items() for array in _make_group(file, name, members, draws, step)]
            for start in watch(range(0, count, step)):
                if not steady.error:
                    _write_block(arrays, [draws.frames[index] for index in range(start, min(start + step, count))], start)
        if steady.error:
            raise steady.error


def frames_in_chunk(draws: Draws) -> int:
    """Return the number of frames in a chunk of the poses of one run. All chunks are about as long: HDF5 stores the last one whole too."""
    count, a_frame = len(draws.frames), sum(values[0].nbytes for values in draws.frames[0].states.values())
    most = int(np.clip(CHUNK_BYTES // a_frame, 1, min(CHUNK_FRAMES, count)))
    return math.ceil(count / math.ceil(count / most))


def _check_room(draws: Draws, path: Path) -> None:
    a_frame = sum(np.asarray(variable.read(draws.frames[0])).nbytes for members in groups(draws).values() for variable in members)
    wanted, free = len(draws.frames) * a_frame, shutil.disk_usage(path.parent).free
    if wanted > free:
        raise input_error(path, f"cannot be written ({free / 1e6:.1f} MB are free)", f"{wanted / 1e6:.1f} MB of free space", "free some space")


def _make_group(file: "h5netcdf.File", name: str, members: Sequence[Variable], draws: Draws, step: int) -> Iterator[tuple[Variable, Any]]:
    """Make a group with its coordinates, and yield its variables, which have no values yet."""
    group, lengths = file.create_group(name), sizes(draws)
    group.dimensions = {dim: lengths[dim] for dim in dims_of(members)}
    labels = coordinates(draws, dims_of(members))
    for label, (dim, values) in labels.items():
        _make_coordinate(group, label, dim, values)
    for variable in members:
        dtype = np.asarray(variable.read(draws.frames[0])).dtype
        boolean = dtype.kind == "b"
        shape = tuple(lengths[dim] for dim in variable.dims)
        frames = step if name in IN_CHUNKS else _frames_without_draws(math.prod(shape) * dtype.itemsize // len(draws.frames), step, len(draws.frames))
        chunks = tuple(_chunk(dim, length, frames, name) for dim, length in zip(variable.dims, shape, strict=True))
        checked = {"chunks": chunks, "fletcher32": True} if 0 not in shape else {}
        array = group.create_variable(variable.name, variable.dims, np.dtype("i1") if boolean else dtype, **checked)
        # Follow xarray's conventions: booleans are stored as bytes, and coordinates that are not an index are named in an attribute.
        array.attrs.update({"dtype": "bool"} if boolean else {})
        units = [unit_name(dim) for dim in variable.dims if unit_name(dim) in labels]
        array.attrs.update({"coordinates": " ".join(units)} if units else {})
        array.attrs.update(variable.attributes)
        yield variable, array


def _make_coordinate(group: Any, label: str, dim: str, values: NDArray[Any] | list[str]) -> None:
    import h5py

    if isinstance(values, list):
        group.create_variable(label, (dim,), h5py.string_dtype(), data=np.array(values, dtype=object))
    else:
        group.create_variable(label, (dim,), values.dtype, data=values)


def _chunk(dim: str, length: int, frames: int, group: str) -> int:
    return 1 if dim == "chain" and group in IN_CHUNKS else frames if dim == "frame" else length


def _frames_without_draws(a_frame: int, step: int, count: int) -> int:
    """Return the number of frames in a chunk of a variable without draws: all, up to CHUNK_BYTES.

    HDF5 writes a chunk that is larger than its cache anew for every block of frames: the time for it would grow with the square of the length.
    """
    if a_frame * count <= CHUNK_BYTES:
        return count
    return max(CHUNK_BYTES // (a_frame * step), 1) * step


def _write_block(arrays: Sequence[tuple[Variable, Any]], frames: Sequence[FrameResult], start: int) -> None:
    for variable, array in arrays:
        place = [slice(None)] * len(variable.dims)
        place[variable.frame_axis] = slice(start, start + len(frames))
        values = variable.stack(frames)
        array[tuple(place)] = values.astype(array.dtype, copy=False)


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


# This group has a few numbers a frame, and is read at once.
SMALL = "filter"


def tree_on_demand(draws: Draws, attributes: Mapping[str, Any] | None = None) -> "xr.DataTree":
    """Return the tree of `to_datatree(draws, attributes)`. Its draws are read, some frames at a time, when they are used."""
    import xarray as xr

    lengths, by_group = sizes(draws), groups(draws)
    small: dict[str, list[Any]] = {variable.name: [] for variable in by_group[SMALL]}
    for frame in draws.frames:
        for variable in by_group[SMALL]:
            small[variable.name].append(variable.read(frame))
    datasets = {}
    for group, members in by_group.items():
        arrays = {}
        for variable in members:
            shape = tuple(lengths[dim] for dim in variable.dims)
            values = np.stack(small[variable.name], axis=variable.frame_axis) if group == SMALL else _lazily(variable, draws.frames, shape)
            arrays[variable.name] = xr.Variable(variable.dims, values, variable.attributes)
        datasets[group] = xr.Dataset(arrays, coordinates(draws, dims_of(members)))
    tree = xr.DataTree.from_dict(datasets)
    tree.attrs.update(attributes_of(draws, attributes))
    return tree


def _lazily(variable: Variable, frames: Frames, shape: tuple[int, ...]) -> Any:
    """Return an array of xarray that reads the frames of an index, as xarray's guide to backends describes it."""
    from xarray.backends import BackendArray
    from xarray.core import indexing

    class OnDemand(BackendArray):
        def __init__(self) -> None:
            self.shape, self.dtype = shape, np.asarray(variable.read(frames[0])).dtype

        def __getitem__(self, key: indexing.ExplicitIndexer) -> NDArray[Any]:
            return indexing.explicit_indexing_adapter(key, shape, indexing.IndexingSupport.BASIC, self.read)

        def read(self, key: tuple[Any, ...]) -> NDArray[Any]:
            axis = variable.frame_axis
            places = range(shape[axis])[key[axis]]
            single = isinstance(places, int)
            values = variable.stack([frames[index] for index in ([places] if single else places)])
            return values[(*key[:axis], 0 if single else slice(None), *key[axis + 1 :])]

    return indexing.LazilyIndexedArray(OnDemand())
