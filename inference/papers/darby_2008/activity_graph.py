"""An activity as a graph: its states in the plane of the first two features, and the transitions between them (Darby, Li & Costen 2008, Fig. 1b)."""

from pathlib import Path

import numpy as np

from bayes_body.base.files.atomic import replacing
from bayes_body.model.dynamics.activity import Activity
from bayes_body.view.colours import GREY, INK

# Rarer transitions are left out, as are those from a state to itself.
LEAST, ELLIPSE_POINTS = 0.05, 40


def draw_activity(path: Path, activity: Activity) -> None:
    """Write a .png: an ellipse of one standard deviation for each state, and an arrow for each transition, as wide as it is probable.

    Raises:
        InputError: the file cannot be written.
    """
    from matplotlib.figure import Figure

    places, transition = activity.locations[:, :2], activity.transition * (1 - np.eye(len(activity.transition)))
    # Given that the state changes: a walk stays in a state for several frames.
    changes = transition / np.maximum(transition.sum(axis=1, keepdims=True), 1e-12)
    figure = Figure(figsize=(7, 3.4), layout="constrained")
    axes = figure.subplots()
    circle = np.stack([function(np.linspace(0, 2 * np.pi, ELLIPSE_POINTS)) for function in (np.cos, np.sin)])
    for place, covariance in zip(places, activity.covariances[:, :2, :2], strict=True):
        outline = place[:, None] + np.linalg.cholesky(covariance) @ circle
        axes.plot(*outline, color=GREY, linewidth=0.7)
    for source, target in np.argwhere(changes > LEAST):
        style = {"arrowstyle": "->", "color": INK, "linewidth": 2.5 * changes[source, target], "shrinkA": 3, "shrinkB": 3}
        axes.annotate("", tuple(places[target]), tuple(places[source]), arrowprops=style)
    axes.plot(*places.T, "o", color=INK, markersize=4)
    axes.set(xlabel="first feature, rad", ylabel="second feature, rad", aspect="equal")
    with replacing(path) as partial:
        figure.savefig(partial, format="png", dpi=100)
