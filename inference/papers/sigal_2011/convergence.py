"""How far the beliefs move in each iteration of message passing (Sigal et al. 2011, Fig. 8 and 11)."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from bayes_body.base.files.atomic import replacing
from bayes_body.tracking.draws import Draws
from bayes_body.view.colours import GREY, INK


def changes_of(draws: Draws) -> Float[np.ndarray, "frame iteration node"]:
    """Return how far the mean of each belief moves in each iteration but the first, in its standard deviations (`FilterInfo.messages`)."""
    return np.stack([np.asarray(frame.info.messages["message_change"])[0, 1:] for frame in draws.frames])


def draw_convergence(path: Path, changes: Float[np.ndarray, "frame iteration node"]) -> None:
    """Write a .png: a grey line for each part, a black one for their mean, over the iterations.

    Raises:
        InputError: the file cannot be written.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    figure = Figure(figsize=(6, 3.4), layout="constrained")
    axes, iterations = figure.subplots(), np.arange(2, changes.shape[1] + 2)
    by_part = changes.mean(axis=0)
    axes.plot(iterations, by_part, color=GREY, linewidth=0.7)
    axes.plot(iterations, by_part.mean(axis=1), ".-", color=INK, label="mean over the parts")
    axes.plot([], [], color=GREY, linewidth=0.7, label="one part")
    axes.set(xlabel="iteration of message passing", ylabel="change of a belief's mean,\nstandard deviations", ylim=(0, None))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.legend()
    with replacing(path) as partial:
        figure.savefig(partial, format="png", dpi=100)
