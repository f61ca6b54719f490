"""Plot the ranks of each quantity with ArviZ: the difference between their distribution function and the uniform one, and ArviZ's test POT-C.

POT-C (Tesso & Vehtari 2026) combines a test of each sorted value by Cauchy's distribution, and marks in purple the values that contribute most to a
deviation. It shows where ranks deviate. The verdict rests on the bands (workshop/calibration/bands.py), whose p-values are exact.

For ArviZ, the ranks of a check are a tree with the group `prior_sbc`, which `arviz.plot_ecdf_pit` reads; it is also stored as a NetCDF file.

ArviZ's test of uniformity (POT-C) is for continuous values. It counts the many equal ones among plain ranks as a deviation: 400 uniform ranks in 20
bins have a p-value near 0.01. Therefore each rank is spread evenly over its bin, `(rank + u) / bins` with u uniform on 0 ... 1. If the ranks are
uniform on 0 ... bins - 1, these values are uniform on 0 ... 1, exactly. The rank is the integer part of `value * bins`.
"""

from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib.pyplot as plt
import numpy as np

from bayes_body.base.files.atomic import replacing
from bayes_body.results.posterior.stream import save_posterior
from bayes_body.view.colours import GREY, INK, WARNING
from bayes_body.view.report.close_ups import arviz_plots
from bayes_body.workshop.calibration.check import Findings
from bayes_body.workshop.calibration.verdict import rank_limits, ranked_quantities

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
    coordinates = {"chain": [0], "draw": np.arange(ranks.shape[1]), "quantity": [findings.names[place] for place in places]}
    return xr.DataTree.from_dict({GROUP: xr.Dataset({VARIABLE: (tuple(coordinates), spread, {"bins": findings.bins})}, coordinates)})


def save_ranks(findings: Findings, path: Path) -> None:
    """Write the tree as NetCDF, completely or not at all; `xarray.open_datatree` or `arviz.from_netcdf` reads it.

    Raises:
        InputError: the file cannot be written.
    """
    save_posterior(rank_tree(findings), path)


COLUMNS, PANEL = 4, (3.0, 2.1)


def draw_ranks(findings: Findings, path: Path, title: str) -> None:
    """Draw one panel per quantity.

    Args:
        findings: the replications' figures.
        path: the picture; its suffix gives the format.
        title: title above all panels.

    Raises:
        InputError: the file cannot be written.
    """
    import arviz as az
    from arviz_base.labels import NoVarLabeller

    count, fails = len(ranked_quantities(findings)), rank_limits(findings).fails
    size = (PANEL[0] * COLUMNS, PANEL[1] * -(-count // COLUMNS) + 0.9)
    with arviz_plots():
        drawn = az.plot_ecdf_pit(
            rank_tree(findings),
            method="pot_c",
            envelope_prob=1 - fails,
            backend="matplotlib",
            labeller=NoVarLabeller(),
            col_wrap=COLUMNS,
            figure_kwargs={"figsize": size, "layout": "constrained"},
            visuals={
                "ecdf_lines": {"color": INK},
                "suspicious_points": {"color": WARNING},
                "credible_interval": {"color": GREY, "alpha": 0.25},
                "title": {"parse_math": False, "size": 9},
                "xlabel": False,
                "p_value_text": {"text": lambda p: f"POT-C p = {p:.2g}", "size": 8},
            },
        )
        figure = drawn.viz["figure"].item()
        try:
            figure.suptitle(title, fontsize=11, parse_math=False)
            figure.supxlabel("posterior level of the truth", fontsize=9)
            figure.supylabel("fraction of truths below, minus the level", fontsize=9)
            with replacing(path) as partial:
                figure.savefig(partial, dpi=110)
        finally:
            plt.close(figure)
