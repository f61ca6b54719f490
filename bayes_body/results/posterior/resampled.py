"""Draws of equal weight from a posterior's tree, for functions that do not know weights, such as those of ArviZ."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from bayes_body.base.errors import input_error
from bayes_body.results.posterior.layout import WEIGHTS
from bayes_body.results.posterior.resampling import RESAMPLING_SEED, systematic_resampling

if TYPE_CHECKING:
    import xarray as xr

STATS, LOG_WEIGHT = "sample_stats", "log_weight"
BY_DRAW = ("chain", "draw", "frame")


def equal_weight(tree: "xr.DataTree", count: int | None = None, seed: int = RESAMPLING_SEED) -> "xr.DataTree":
    """Return the tree with draws of equal weight, resampled from its weighted draws.

    Each chain and frame is resampled systematically, in random order; the variables of a state stay together. A frame whose draws have equal weights
    keeps them in their order. Resampled draws repeat: their number is not an effective sample size, which `bayes_body.diagnose` computes from the
    weights. Draws of two frames are not paths. All frames of the tree are read into memory: of a long recording, select some first, such as
    `tree.sel(frame=[0, 1])`.

    Args:
        tree: from `to_datatree` or `posterior.nc`, or some of its frames.
        count: number of draws of a chain and frame; by default as many as there are.
        seed: seed of the resampling. A frame's draws do not depend on the other frames.

    Raises:
        InputError: the tree has no weights, or `count` is not positive.
    """
    import xarray as xr

    _check(tree, count)
    stored_weights = tree[STATS][LOG_WEIGHT]
    log_weights = stored_weights.expand_dims([dim for dim in BY_DRAW if dim not in stored_weights.dims]).transpose(*BY_DRAW)
    frames = np.asarray(log_weights["frame"] if "frame" in log_weights.coords else np.arange(log_weights.sizes["frame"]))
    chosen = _chosen(np.asarray(log_weights, float), frames, count, seed)
    groups = {name: _taken(group.to_dataset(), chosen) if "draw" in group.dims else group.to_dataset() for name, group in tree.children.items()}
    resampled_tree = xr.DataTree.from_dict(groups)
    resampled_tree.attrs.update({name: value for name, value in tree.attrs.items() if name != WEIGHTS})
    return resampled_tree


def _check(tree: "xr.DataTree", count: int | None) -> None:
    if STATS not in getattr(tree, "children", ()) or LOG_WEIGHT not in tree[STATS]:
        expected = "a tree with weighted draws, from bayes_body.to_datatree or posterior.nc"
        raise input_error("equal_weight: tree", f"no {STATS}/{LOG_WEIGHT}", expected, "use draws without weights as they are")
    if count is not None and count < 1:
        raise input_error("equal_weight: count", str(count), "a whole number from 1 up", "give another number")


def _chosen(
    log_weights: Float[np.ndarray, "chain draw frame"], frames: Int[np.ndarray, " frame"], count: int | None, seed: int
) -> Int[np.ndarray, "chain count frame"]:
    """Return the indices of the draws, for each chain and frame."""
    chains, draws, _ = log_weights.shape
    number = draws if count is None else count
    chosen = np.empty((chains, number, len(frames)), int)
    for place, frame in enumerate(frames):
        rng = np.random.default_rng((seed, int(frame)))
        for chain in range(chains):
            chain_log_weights = log_weights[chain, :, place]
            as_they_are = number == draws and chain_log_weights.max() == chain_log_weights.min()
            chosen[chain, :, place] = (
                np.arange(draws) if as_they_are else systematic_resampling(rng, np.exp(chain_log_weights - chain_log_weights.max()), number)
            )
    return chosen


def _taken(group: "xr.Dataset", chosen: Int[np.ndarray, "chain count frame"]) -> "xr.Dataset":
    """Return a group with the chosen draws; all its arrays have draws."""
    import xarray as xr

    arrays = {}
    for name, values in group.data_vars.items():
        absent = [dim for dim in BY_DRAW if dim not in values.dims]
        whole = values.expand_dims(absent).variable.transpose(*BY_DRAW, ...)
        index = chosen.reshape(chosen.shape + (1,) * (whole.ndim - len(BY_DRAW)))
        taken = np.take_along_axis(whole.values, index, axis=1)
        equal = np.full_like(taken, -np.log(chosen.shape[1])) if name == LOG_WEIGHT else taken
        arrays[name] = xr.Variable(whole.dims, equal, values.attrs).isel(dict.fromkeys(absent, 0)).transpose(*values.dims)
    labels = {name: values for name, values in group.coords.items() if name != "draw"}
    return xr.Dataset(arrays, labels | {"draw": np.arange(chosen.shape[1])}, group.attrs)
