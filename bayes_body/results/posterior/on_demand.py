"""The tree of `to_datatree` whose arrays are read from the frames when they are needed, so that memory does not grow with the number of frames."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bayes_body.results.posterior.layout import Variable, attributes_of, coordinates, dims_of, groups, sizes
from bayes_body.tracking.draws import Draws, Frames

if TYPE_CHECKING:
    import xarray as xr

# This group has a few numbers a frame, and is read at once.
SMALL = "filter"


def tree_on_demand(draws: Draws, attributes: Mapping[str, Any] | None = None) -> "xr.DataTree":
    """Return the tree of `to_datatree(draws, attributes)`. Its draws are read, some frames at a time, when they are used."""
    import xarray as xr

    lengths, by_group = sizes(draws), groups(draws)
    small: dict[str, list[Any]] = {variable.name: [] for variable in by_group[SMALL]}
    for frame in draws.frames:
        for variable in by_group[SMALL]:
            small[variable.name].append(variable.of(frame))
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
            self.shape, self.dtype = shape, np.asarray(variable.of(frames[0])).dtype

        def __getitem__(self, key: indexing.ExplicitIndexer) -> NDArray[Any]:
            return indexing.explicit_indexing_adapter(key, shape, indexing.IndexingSupport.BASIC, self.read)

        def read(self, key: tuple[Any, ...]) -> NDArray[Any]:
            axis = variable.frame_axis
            places = range(shape[axis])[key[axis]]
            single = isinstance(places, int)
            values = variable.stack([frames[index] for index in ([places] if single else places)])
            return values[(*key[:axis], 0 if single else slice(None), *key[axis + 1 :])]

    return indexing.LazilyIndexedArray(OnDemand())
