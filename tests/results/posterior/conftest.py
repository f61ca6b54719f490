"""A posterior made by hand: as many runs, particles and frames as a test wants, sound until it is damaged."""

import numpy as np
import pytest
import xarray as xr


@pytest.fixture
def make_tree():
    """`make_tree(pose=..., log_weight=...)`: a tree of normal draws with the kernel's name, but for the arrays given: (chain, draw, frame, ...)."""

    def call(kernel="sir", runs=3, draws=400, frames=12, dofs=("hip", "knee"), **arrays):
        rng = np.random.default_rng(5)
        given = {
            "pose": rng.normal(size=(runs, draws, frames, len(dofs))),
            "log_weight": np.full((runs, draws, frames), -np.log(draws)),
            "ancestor": np.tile(np.arange(draws)[None, :, None], (runs, 1, frames)),
            "log_evidence": np.zeros((runs, frames)),
            "lost": np.zeros((runs, frames), bool),
            "acceptance_rate": np.full((runs, frames, 2), np.nan),
        } | arrays
        shape = {"chain": np.arange(runs), "draw": np.arange(draws), "frame": np.arange(frames)}
        filters = {name: (("chain", "frame", "layer")[: given[name].ndim], given[name]) for name in ("log_evidence", "lost", "acceptance_rate")}
        if "seen" in given:
            filters["seen"] = (("frame", "camera"), given["seen"])
        stats = {name: (("chain", "draw", "frame"), given[name]) for name in ("log_weight", "ancestor")}
        tree = xr.DataTree.from_dict(
            {
                "posterior": xr.Dataset({"pose": (("chain", "draw", "frame", "dof"), given["pose"])}, shape | {"dof": list(dofs)}),
                "sample_stats": xr.Dataset(stats, shape),
                "filter": xr.Dataset(filters, {"camera": ["left", "right"]} if "seen" in given else {}),
            }
        )
        tree.attrs["kernel"] = kernel
        return tree

    return call
