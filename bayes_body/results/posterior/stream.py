"""Write `posterior.nc` frame by frame in bounded memory: the tree of `to_datatree`, for xarray and ArviZ.

The groups `posterior` and `sample_stats` are stored in chunks: all draws of one run in some frames. The group `filter` has a few numbers per frame,
and each of its variables is stored in one chunk. All chunks have checksums, which HDF5 verifies when it reads them. The file depends neither on
when it was written nor on how often the run was resumed.
"""

import math
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bayes_body.base.errors import input_error
from bayes_body.base.files.atomic import make_folder, replacing
from bayes_body.base.files.error_deferring import ErrorDeferringFile
from bayes_body.results.posterior.layout import Variable, attributes_of, coordinates, dims_of, groups, sizes, unit_name
from bayes_body.tracking.draws import Draws, FrameResult

if TYPE_CHECKING:
    import h5netcdf

# Size of a chunk in bytes, and the largest number of frames in it.
CHUNK_BYTES, CHUNK_FRAMES = 2**20, 256
IN_CHUNKS = ("posterior", "sample_stats")


def stream_posterior(draws: Draws, path: Path, attributes: Mapping[str, Any] | None = None) -> None:
    """Write the tree of `to_datatree(draws, attributes)` as NetCDF, either completely or not at all.

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
            for start in range(0, count, step):
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
    a_frame = sum(np.asarray(variable.of(draws.frames[0])).nbytes for members in groups(draws).values() for variable in members)
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
        dtype = np.asarray(variable.of(draws.frames[0])).dtype
        boolean = dtype.kind == "b"
        shape = tuple(lengths[dim] for dim in variable.dims)
        # Checksums need chunks. Without draws, one chunk holds all.
        chunks = tuple(_chunk(dim, length, step) for dim, length in zip(variable.dims, shape, strict=True)) if name in IN_CHUNKS else shape
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


def _chunk(dim: str, length: int, step: int) -> int:
    return 1 if dim == "chain" else step if dim == "frame" else length


def _write_block(arrays: Sequence[tuple[Variable, Any]], frames: Sequence[FrameResult], start: int) -> None:
    for variable, array in arrays:
        place = [slice(None)] * len(variable.dims)
        place[variable.frame_axis] = slice(start, start + len(frames))
        values = variable.stack(frames)
        array[tuple(place)] = values.astype(array.dtype, copy=False)
