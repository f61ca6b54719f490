"""Plot the ranks of each quantity with ArviZ: the difference between their distribution function and the uniform one, and ArviZ's test POT-C.

POT-C (Tesso & Vehtari 2026) combines a test of each sorted value by Cauchy's distribution, and marks in purple the values that contribute most to a
deviation. It shows where ranks deviate. The verdict rests on the bands (workshop/calibration/bands.py), whose p-values are exact.
"""

from pathlib import Path

import matplotlib.pyplot as plt

from bayes_body.base.files.atomic import replacing
from bayes_body.view.colours import GREY, INK, WARNING
from bayes_body.view.report.close_ups import arviz_plots
from bayes_body.workshop.calibration.check import Findings
from bayes_body.workshop.calibration.rank_tree import rank_tree
from bayes_body.workshop.calibration.verdict import rank_limits, ranked_quantities

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
