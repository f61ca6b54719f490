"""The learned walking cycle: the mean angle of the left knee, and its first modes (Sidenbladh, Black & Fleet 2000, Fig. 3)."""

from pathlib import Path

import numpy as np

from bayes_body.base.files.atomic import replacing
from bayes_body.model.dynamics.angle_cycle import AngleCycle
from bayes_body.view.colours import INK, SIDES, run_line
from bayes_body.workshop.learning.gait import terms

SHOWN, DOF = 3, "l_knee"


def draw_eigencurves(path: Path, cycle: AngleCycle) -> None:
    """Write a .png with the mean angle of the left knee over the phase, and the change by one standard deviation of each of the first modes.

    Raises:
        InputError: the file cannot be written.
    """
    from matplotlib.figure import Figure

    phases, dof = np.linspace(0, 1, 101), cycle.names.index(DOF)
    series = terms(phases)
    figure = Figure(figsize=(8, 3.2), layout="constrained")
    mean, modes = figure.subplots(1, 2)
    mean.plot(phases, np.degrees(series @ cycle.mean[:, dof]), color=SIDES["l"])
    mean.set(title="mean of the left knee", xlabel="phase, cycles", ylabel="angle, degrees")
    for number in range(SHOWN):
        modes.plot(phases, np.degrees(series @ cycle.modes[number, :, dof]), color=INK, linestyle=run_line(number), label=f"mode {number + 1}")
    modes.set(title="its first modes, one standard deviation", xlabel="phase, cycles", ylabel="angle, degrees")
    modes.legend(fontsize="small")
    with replacing(path) as partial:
        figure.savefig(partial, format="png", dpi=100)
