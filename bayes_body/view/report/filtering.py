"""The section on the filter over the frames: effective particles, weights, ancestors, log-evidence, layers, and the cameras in use."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float

from bayes_body.base.errors import escaped
from bayes_body.view.colours import INK, SEQUENTIAL
from bayes_body.view.report.figures import bins, draw_limit, encoded, log_counts, log_values, new_panel, point_marks, time_axis, time_label
from bayes_body.view.report.inspection import Inspection
from bayes_body.view.report.markup import Markup, Picture, figures, section, tag
from bayes_body.view.report.panels import frame_panel, run_panel


def filter_section(inspection: Inspection) -> Markup:
    """Return the section with all panels for which the kernel has data."""
    panels = [panel for part in (_weights, _ancestry, _evidence, _layers, _cameras) for panel in part(inspection)]
    lines = "Each line is a run." if inspection.runs > 1 else "There is a single run."
    lost = " Lost frames are shaded purple." if inspection.lost.any() else ""
    parts = [tag("p", f"{lines} Purple lines are the limits beyond which there is a warning.{lost}")]
    if inspection.diagnosis.mode_seeker:
        parts.append(tag("p", f"The kernel {inspection.diagnosis.kernel} estimates no evidence, so there is no panel for it."))
    return section("filter", "Filter", *parts, figures(panels))


def _weights(inspection: Inspection) -> Iterator[Picture]:
    diagnosis, count = inspection.diagnosis, inspection.diagnosis.particles
    least = max(inspection.limits.ess, inspection.limits.ess_share * count)
    figure, axes = run_panel(inspection, "Effective particles", f"of {count:,} (log scale)", diagnosis.ess)
    log_counts(axes, count)
    if not diagnosis.mode_seeker:
        draw_limit(axes, least)
    yield encoded(figure, f"Effective sample size over the frames, median {np.median(diagnosis.ess):.0f} of {count} particles.")
    # The weights of a mode seeker are not importance weights.
    if np.isfinite(diagnosis.pareto_k).any() and not diagnosis.mode_seeker:
        figure, axes = run_panel(inspection, "Tail of the weights", "Pareto k", np.where(np.isfinite(diagnosis.pareto_k), diagnosis.pareto_k, np.nan))
        draw_limit(axes, inspection.limits.pareto_k)
        worst = np.max(diagnosis.pareto_k[np.isfinite(diagnosis.pareto_k)])
        yield encoded(figure, f"Pareto k of the weights over the frames, at most {worst:.2f}; the limit is {inspection.limits.pareto_k}.")


def _ancestry(inspection: Inspection) -> Iterator[Picture]:
    diagnosis = inspection.diagnosis
    for lag, counts in zip(diagnosis.lags, diagnosis.ancestors, strict=True):
        if not np.isfinite(counts).any():
            continue
        back = "1 frame back" if lag == 1 else f"{lag} frames back"
        figure, axes = run_panel(inspection, f"Ancestors {back}", "particles (log scale)", counts)
        log_counts(axes, diagnosis.particles)
        if lag == 1:
            draw_limit(axes, inspection.limits.ancestors)
        yield encoded(figure, f"Number of particles {back} that have descendants, at least {np.nanmin(counts):.0f}.")


def _evidence(inspection: Inspection) -> Iterator[Picture]:
    diagnosis = inspection.diagnosis
    if not np.isfinite(diagnosis.log_evidence).any():
        return
    figure, axes = run_panel(
        inspection, "Log-evidence of a frame", "nats", np.where(np.isfinite(diagnosis.log_evidence), diagnosis.log_evidence, np.nan)
    )
    yield encoded(figure, "Log-evidence of each frame given the frames before it.")
    spread = diagnosis.evidence_sd_frames
    if np.isfinite(spread).any():
        figure, axes = run_panel(inspection, "Spread of the log-evidence", "sd over the runs, nats", spread[None])
        axes.set_ylim(bottom=0)
        yield encoded(figure, f"Standard deviation over the runs of the log-evidence of a frame, at most {np.nanmax(spread):.2f} nats.")


def _layers(inspection: Inspection) -> Iterator[Picture]:
    """Yield plots of survival rates, inverse temperatures and acceptance of each layer, as medians of the runs; none for kernels without layers."""
    from matplotlib.ticker import MaxNLocator

    group = inspection.run.tree["filter"]
    if "survival_rate" not in group:
        return
    rates, powers = (np.asarray(group[name], float) for name in ("survival_rate", "inverse_temperature"))
    if rates.shape[-1] > 1:
        numbers = np.isfinite(rates).sum(axis=-1).astype(float)
        if np.ptp(numbers):
            figure, axes = run_panel(inspection, "Layers", "layers per frame", numbers)
            axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
            yield encoded(figure, f"Number of layers in each frame, from {numbers.min():.0f} to {numbers.max():.0f}.")
        yield _by_layer(inspection, rates, "Survival rate of a layer", "fraction of particles", False)
        yield _by_layer(inspection, powers, "Inverse temperature of a layer", "power of the likelihood", True)
    # The acceptance of Markov chains is shown in their own section.
    if np.isfinite(inspection.diagnosis.acceptance_rate).any() and inspection.diagnosis.mixing is None:
        yield _by_layer(
            inspection, inspection.diagnosis.acceptance_rate, "Acceptance of a layer", "fraction of moves", False, inspection.limits.acceptance
        )


def _by_layer(
    inspection: Inspection,
    values: Float[np.ndarray, "run frame layer"],
    title: str,
    y_label: str,
    logarithmic: bool,
    limits: tuple[float, ...] = (),
) -> Picture:
    import matplotlib as mpl

    has_values = np.isfinite(values).any(axis=(0, 1))
    layers = np.flatnonzero(has_values)
    binned = bins(values.shape[1])
    colours = mpl.colormaps[SEQUENTIAL](np.linspace(0.35, 1, max(len(layers), 2)))
    figure, axes = frame_panel(inspection, title, inspection.x_label, y_label)
    for number, (layer, colour) in enumerate(zip(layers, colours[: len(layers)], strict=True)):
        line = [_median(values[:, piece, layer]) for piece in binned]
        named = len(layers) > 1 and number in (0, len(layers) - 1)
        axes.plot(
            [piece.start for piece in binned],
            line,
            color=colour,
            label=f"layer {layer + 1}" if named else None,
            **point_marks(values.shape[1]),
        )
    if logarithmic:
        log_values(axes)
    else:
        axes.set_ylim(-0.03, 1.03)
    for limit in limits:
        draw_limit(axes, limit)
    return encoded(figure, f"{title} over the frames, the median of the runs, from {np.nanmin(values):.3g} to {np.nanmax(values):.3g}.")


def _median(values: Float[np.ndarray, "run some"]) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else float("nan")


def _cameras(inspection: Inspection) -> Iterator[Picture]:
    """Yield a plot with one strip for each camera, coloured in the frames in which its image was used."""
    diagnosis = inspection.diagnosis
    if diagnosis.seen is None:
        return
    count = diagnosis.seen.shape[1]
    figure, axes = new_panel("Cameras in use", time_label(inspection.fps), "camera", (3.6, max(1.6, 0.9 + 0.25 * count)))
    for camera in range(count):
        axes.broken_barh(_stretches(diagnosis.seen[:, camera]), (camera - 0.35, 0.7), color=INK, linewidth=0)
    axes.set_yticks(range(count), [_short(name) for name in diagnosis.cameras])
    axes.set_ylim(count - 0.5, -0.5)
    axes.grid(visible=False)
    time_axis(axes, diagnosis.seen.shape[0], inspection.fps)
    axes.set_xlim(-0.5, diagnosis.seen.shape[0] - 0.5)
    camera_shares = "; ".join(f"{name} in {share:.0%}" for name, share in zip(diagnosis.cameras, diagnosis.seen.mean(axis=0), strict=True))
    yield encoded(figure, f"Fraction of frames in which each camera was used: {camera_shares}.")


def _stretches(flags: Bool[np.ndarray, " frame"]) -> list[tuple[float, float]]:
    """Return (start, width) of each stretch of frames."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]]))).reshape(-1, 2)
    return [(start - 0.5, float(stop - start)) for start, stop in edges.tolist()]


def _short(name: str) -> str:
    name = escaped(name)
    return name if len(name) <= 9 else f"{name[:8]}…"
