"""The densities of log amplitude and phase on the outlines of people that the definitions of this paper have (Poon & Fleet 2002, Fig. 3, right)."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np

from bayes_body.base.files.atomic import replacing
from bayes_body.model.likelihood.edge_phase import EdgeStatistics, Options, amplitude_log_density, share_of, wrapped_normal
from bayes_body.view.colours import INK, run_line


def draw_densities(path: Path, options: Options) -> None:
    """Write a .png with the density of the logarithm of the amplitude, and that of the phase at a small and a large amplitude.

    Args:
        path: the file.
        options: of a likelihood `edge_phase`.

    Raises:
        InputError: the file cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3.2), layout="constrained")
    amplitudes, phases = figure.subplots(1, 2)
    phase = jnp.linspace(0, jnp.pi, 200)
    for number, scale in enumerate(options.scale):
        low, high = scale.log_amplitude
        statistics = EdgeStatistics(*map(np.asarray, (scale.epsilon, scale.amplitude, scale.log_amplitude, scale.log_occluded)))
        rho = jnp.linspace(low, high, 200)
        label = f"wavelength {scale.wavelength_px:g} px"
        density = np.exp(np.asarray(amplitude_log_density(share_of(rho, statistics), statistics)))
        amplitudes.plot(rho, density, color=INK, linestyle=run_line(number), label=label)
        step_edges = scale.epsilon[0]
        mixture = step_edges * np.asarray(wrapped_normal(phase - np.pi / 2)) + (1 - step_edges) / np.pi
        phases.plot(phase / np.pi, mixture, color=INK, linestyle=run_line(number), label=f"{label}, smallest amplitude")
    phases.plot(phase / np.pi, np.asarray(wrapped_normal(phase - np.pi / 2)), color=INK, linewidth=2.5, label="step edges alone")
    amplitudes.set(xlabel="logarithm of the amplitude in grey levels", ylabel="density")
    phases.set(xlabel="phase / π", ylabel="density per radian", ylim=(0, 1.3))
    for axes in (amplitudes, phases):
        axes.legend(fontsize="small")
    with replacing(path) as partial:
        figure.savefig(partial, format="png", dpi=100)
