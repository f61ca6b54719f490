"""Plot learned edge statistics: fitted densities of log amplitude and phase over histograms of the data (Poon & Fleet 2002, Fig. 3)."""

import math
from collections.abc import Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from bayes_body.base.files.atomic import replacing
from bayes_body.model.likelihood.edge_phase import EdgeStatistics, amplitude_log_density, phase_and_log_amplitude, share_of, wrapped_normal
from bayes_body.recording.evidence.edge_phase import Response
from bayes_body.view.colours import GREY, INK

# Amplitudes at which the phase's density is drawn, as fractions of their range.
WEAK, STRONG = 0.25, 0.85


def draw_edge_statistics(path: Path, scales: Sequence[tuple[float, EdgeStatistics, Response]]) -> None:
    """Write a .png with a row of plots for each scale (wavelength in pixels, statistics, responses on boundaries).

    Raises:
        InputError: the file cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3 * len(scales)), layout="constrained")
    for (left, right), (wavelength, statistics, response) in zip(figure.subplots(len(scales), 2, squeeze=False), scales, strict=True):
        phase, rho = (np.asarray(feature) for feature in phase_and_log_amplitude(jnp.asarray(response.even), jnp.asarray(response.odd)))
        low, high = np.asarray(statistics.log_amplitude)
        grid = np.linspace(low, high, 200)
        left.hist(rho, bins=np.linspace(low, high, 40), density=True, color=GREY, alpha=0.4, label="data")
        left.plot(grid, np.exp(amplitude_log_density(share_of(jnp.asarray(grid), statistics), statistics)), color=INK, label="learned")
        left.set(xlabel="log amplitude, log of grey levels", ylabel="density", title=f"wavelength {wavelength:g} px")
        left.legend()
        share, turns = (rho - low) / (high - low), np.linspace(-math.pi / 2, math.pi / 2, 200)
        for name, mask, about, line in (("weak", share < 0.5, WEAK, "--"), ("strong", share > 0.7, STRONG, "-")):
            right.hist((phase[mask] + math.pi / 2) / math.pi, bins=40, density=True, histtype="step", color=GREY, linestyle=line, alpha=0.6)
            epsilon = statistics.epsilon[0] + (statistics.epsilon[1] - statistics.epsilon[0]) * about
            density = epsilon * np.asarray(wrapped_normal(jnp.asarray(turns))) + (1 - epsilon) / math.pi
            right.plot((turns + math.pi / 2) / math.pi, density * math.pi, color=INK, linestyle=line, label=f"{name} responses")
        right.set(xlabel="phase, fraction of π", ylabel="density", title="phase: a step edge has π/2")
        right.legend()
    with replacing(path) as partial:
        figure.savefig(partial, format="png", dpi=120)
