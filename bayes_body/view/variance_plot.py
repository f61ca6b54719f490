"""Error ratios of two samplers by dof, with their intervals: what Poon & Fleet's Fig. 8 compares."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from bayes_body.files import replacing


def draw_ratios(path: Path, ratios: Mapping[str, Mapping[str, Sequence[float]]]) -> None:
    """A row of points a dof, a colour for what was held equal, by that and by dof: ratio, low, high; into a .png.

    Raises:
        InputError: the file cannot be written.
    """
    from matplotlib.figure import Figure

    dofs = list(next(iter(ratios.values())))
    figure = Figure(figsize=(7, 0.35 * len(dofs) + 1.5), layout="constrained")
    axes = figure.subplots()
    places = np.arange(len(dofs))
    for number, (name, of_dofs) in enumerate(ratios.items()):
        value, low, high = np.array(list(of_dofs.values())).T
        axes.errorbar(value, places + 0.15 * number, xerr=np.stack([value - low, high - value]), fmt="o", capsize=3, label=f"at equal {name}")
    axes.axvline(1, color="0.5")
    axes.set(xscale="log", yticks=places, yticklabels=dofs, xlabel="error² of the particle filter / error² of hybrid Monte Carlo (95 % intervals)")
    axes.invert_yaxis()
    axes.legend()
    with replacing(path) as partial:
        figure.savefig(partial, format="png", dpi=120)
