"""The ranks of a check for ArviZ: a tree with the group `prior_sbc`, which `arviz.plot_ecdf_pit` reads, and its NetCDF file.

ArviZ's test of uniformity (POT-C) is for continuous values. It counts the many equal ones among plain ranks as a deviation: 400 uniform ranks in 20
bins have a p-value near 0.01. Therefore each rank is spread evenly over its bin, `(rank + u) / bins` with u uniform on 0 ... 1. If the ranks are
uniform on 0 ... bins - 1, these values are uniform on 0 ... 1, exactly. The rank is the integer part of `value * bins`.
"""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bayes_body.results.posterior.tree import save_posterior
from bayes_body.workshop.calibration.check import Findings
from bayes_body.workshop.calibration.verdict import ranked_quantities

if TYPE_CHECKING:
    import xarray as xr

GROUP, VARIABLE, SUFFIX = "prior_sbc", "rank", ".ranks.nc"
SEED = 20


def ranks_file(json_file: Path) -> Path:
    """The file of ranks beside the figures: `sir.ranks.nc` for `sir.json`."""
    return json_file.with_suffix(SUFFIX)


def rank_tree(findings: Findings) -> "xr.DataTree":
    """The tree: `prior_sbc/rank` (chain, draw, quantity), on 0 ... 1. Each replication is a draw of the only chain."""
    import xarray as xr

    places = ranked_quantities(findings)
    ranks = findings.ranks["ranks"][None][..., places]
    spread = (ranks + np.random.default_rng(SEED).uniform(size=ranks.shape)) / findings.bins
    where = {"chain": [0], "draw": np.arange(ranks.shape[1]), "quantity": [findings.names[place] for place in places]}
    return xr.DataTree.from_dict({GROUP: xr.Dataset({VARIABLE: (tuple(where), spread, {"bins": findings.bins})}, where)})


def save_ranks(findings: Findings, path: Path) -> None:
    """Write the tree as NetCDF, completely or not at all; `xarray.open_datatree` or `arviz.from_netcdf` reads it.

    Raises:
        InputError: the file cannot be written.
    """
    save_posterior(rank_tree(findings), path)
