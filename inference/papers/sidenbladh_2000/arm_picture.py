"""The posterior of the three shoulder angles over the frames, by its brightness (Sidenbladh, Black & Fleet 2000, Fig. 4, lower row)."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from bayes_body.base.files.atomic import replacing
from bayes_body.tracking.draws import Draws
from bayes_body.view.colours import SEQUENTIAL, WARNING

BINS = 90
# Below this share of a frame's largest bin, nothing is shown: the logarithm of an empty bin is -∞.
LEAST = 1e-3


def draw_shoulder(path: Path, draws: Draws, true_angles: Float[np.ndarray, "frame dof"]) -> None:
    """Write a .png with a panel for each shoulder angle. A purple line is the true angle.

    Args:
        path: the file.
        draws: of one run.
        true_angles: the angles of the arm, radians, in the order of the body's dofs.

    Raises:
        InputError: the file cannot be written.
    """
    from matplotlib.figure import Figure

    names, low, high = draws.model.body.dof_names, draws.model.body.skeleton.low, draws.model.body.skeleton.high
    shoulder = [dof for dof, name in enumerate(names) if name.startswith("shoulder")]
    figure = Figure(figsize=(10, 3.2), layout="constrained")
    panels, pictures = figure.subplots(1, len(shoulder)), []
    for axes, dof in zip(panels, shoulder, strict=True):
        edges = np.degrees(np.linspace(float(low[dof]), float(high[dof]), BINS + 1))
        counts = np.array([_histogram(frame, dof, edges) for frame in draws.frames]).T
        shown = np.log10(np.maximum(counts / counts.max(axis=0), LEAST))
        pictures.append(axes.pcolormesh(np.arange(len(draws.frames) + 1) - 0.5, edges, shown, cmap=SEQUENTIAL))
        axes.plot(np.degrees(true_angles[:, dof]), color=WARNING)
        axes.set(title=names[dof], xlabel="frame", ylabel="angle, degrees")
    figure.colorbar(pictures[-1], label="log10 of the density,\nrelative to the frame's largest")
    with replacing(path) as partial:
        figure.savefig(partial, format="png", dpi=100)


def _histogram(frame, dof: int, edges: Float[np.ndarray, " edge"]) -> Float[np.ndarray, " bin"]:
    angles, weights = np.degrees(np.asarray(frame.states["pose"])[0, :, dof]), np.exp(np.asarray(frame.log_weights)[0])
    return np.histogram(angles, edges, weights=weights)[0]
