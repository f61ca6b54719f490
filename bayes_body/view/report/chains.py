"""The section on the mixing of each frame's Markov chains, with a chain's path over the image as in Poon & Fleet 2002, Fig. 5."""

from collections.abc import Iterator

import cv2
import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import InputError
from bayes_body.results.metrics.fit import outlines, seen_in
from bayes_body.results.posterior.agreement import by_chain
from bayes_body.results.posterior.blocks import coordinate_blocks, pose_blocks
from bayes_body.results.posterior.mixing import Mixing, autocorrelation
from bayes_body.view.colours import GREY, paper, run_line
from bayes_body.view.crop import crop_about
from bayes_body.view.overlay import run_backdrop
from bayes_body.view.report.figures import draw_limit, encoded, median_and_range, new_panel, webp_uri
from bayes_body.view.report.inspection import Inspection, spoken
from bayes_body.view.report.markup import Markup, Picture, figures, section, tag
from bayes_body.view.report.panels import run_panel
from bayes_body.view.report.runs import dof_map

ABOUT = (
    "Each frame is sampled by a few Markov chains, which start from different predictions. If they agree (R-hat near 1), they have found the same "
    "posterior of this frame. The agreement of the runs shows whether another run of the filter finds the same posterior."
)
PATH = (
    "The path of one chain of that frame, from its first state after burn-in (yellow) to its last (violet). A chain that mixes crosses the posterior "
    "many times. A chain that does not mix moves slowly from one end to the other."
)
# Number of states drawn on a path, of dofs whose autocorrelation is shown, the longest side of a picture in pixels, and WebP's quality (up to 100).
STATES, SHOWN, WIDEST, QUALITY = 24, 3, 960, 75


def chain_section(inspection: Inspection) -> Markup:
    """Return the section: figures over the frames, and autocorrelations and a path at the frame with the worst mixing."""
    mixing = inspection.diagnosis.mixing
    if mixing is None:
        return section("chains", "Markov chains", tag("p", "The kernel runs no Markov chains."))
    frame = worst_mixed(mixing)
    draws = _draws(inspection, mixing, frame)
    has_rhat = bool(np.isfinite(mixing.rhat).any())
    parts = [tag("p", ABOUT), figures(_panels(inspection, mixing))]
    parts += (
        [figures([_rhat_map(inspection, mixing)], "wide")]
        if has_rhat
        else [tag("p", "There is no R-hat: each frame has a single chain or too few draws.")]
    )
    parts += [tag("h3", f"Frame {inspection.number(frame)}, with the worst mixing"), figures([_autocorrelations(inspection, mixing, draws, frame)])]
    try:
        pictures = [_path(inspection, mixing, frame)]
    except InputError as error:
        return section("chains", "Markov chains", *parts, tag("p", f"No path is drawn: {error}"))
    return section("chains", "Markov chains", *parts, tag("p", PATH), figures(pictures, "stills"))


def worst_mixed(mixing: Mixing) -> int:
    """Return the frame with the largest R-hat; if there is no R-hat, the frame with the fewest effective draws."""
    if np.isfinite(mixing.rhat).any():
        return int(np.nan_to_num(mixing.rhat, nan=-np.inf).max(axis=(0, 2)).argmax())
    return int(mixing.ess.min(axis=(0, 2)).argmin())


def _draws(inspection: Inspection, mixing: Mixing, frame: int) -> Float[np.ndarray, "chain step dof"]:
    """Return the draws of the first run, radians and metres."""
    (block,) = coordinate_blocks(inspection.run.tree, range(frame, frame + 1), spaces=inspection.run.spaces)
    return by_chain(block.poses[:1], mixing.length)[0, :, :, 0]


def _panels(inspection: Inspection, mixing: Mixing) -> Iterator[Picture]:
    chains = mixing.acceptance.shape[-1]
    average = f"mean of {chains} chains" if chains > 1 else "of the chain"
    yield _panel(inspection, mixing.acceptance.mean(axis=-1), "Acceptance", f"probability, {average}", inspection.limits.acceptance, (-0.03, 1.03))
    yield _panel(inspection, mixing.divergences.sum(axis=-1).astype(float), "Divergences", "trajectories per frame", (), (0.0, None))
    yield _panel(inspection, mixing.ess.min(axis=-1), "Effective draws", f"of {inspection.diagnosis.particles:,}, minimum over dofs", (), (0.0, None))
    yield _panel(inspection, mixing.energy_fraction.mean(axis=-1), "Energy", f"E-BFMI, {average}", (inspection.limits.energy_fraction,), (0.0, None))
    yield _panel(inspection, mixing.step.mean(axis=-1), "Step", f"factor, {average}", (), (0.0, None))


def _panel(
    inspection: Inspection,
    values: Float[np.ndarray, "run frame"],
    title: str,
    label: str,
    limits: tuple[float, ...],
    span: tuple[float, float | None],
) -> Picture:
    figure, axes = run_panel(inspection, title, label, values)
    for limit in limits:
        draw_limit(axes, limit)
    axes.set_ylim(*span)
    return encoded(figure, f"{title} over the frames: {median_and_range(values)}.")


def _rhat_map(inspection: Inspection, mixing: Mixing) -> Picture:
    worst = np.where(np.isnan(mixing.rhat), -np.inf, mixing.rhat).max(axis=0)
    worst = np.where(np.isneginf(worst), np.nan, worst)
    limit = inspection.limits.markov_rhat
    alt = f"R-hat over the chains of every dof and frame, at most {np.nanmax(worst):.2f}."
    return dof_map(inspection, worst, "R-hat over the chains", limit, alt, f"Darker is larger. The line on the colour scale is the limit {limit:g}.")


def _autocorrelations(inspection: Inspection, mixing: Mixing, draws: Float[np.ndarray, "chain step dof"], frame: int) -> Picture:
    """Return the plot of the autocorrelations of the dofs with the fewest effective draws."""
    figure, axes = new_panel("Autocorrelation", "lag, draws", "correlation")
    order = np.argsort(mixing.ess[0, frame], kind="stable")[:SHOWN].tolist()
    for number, dof in enumerate(order):
        # Dofs of one side have one colour: here the line tells them apart.
        axes.plot(
            autocorrelation(draws[:, :, dof]), color=paper(inspection.dofs[dof]), linestyle=run_line(number), label=spoken(inspection.dofs[dof])
        )
    axes.axhline(0, color=GREY, linewidth=0.8)
    axes.set_ylim(-0.4, 1.05)
    named = ", ".join(f"{spoken(inspection.dofs[dof])} {mixing.ess[0, frame, dof]:.0f}" for dof in order)
    return encoded(figure, f"Autocorrelation within the chains of frame {inspection.number(frame)}; effective draws of the slowest dofs: {named}.")


def _path(inspection: Inspection, mixing: Mixing, frame: int) -> Picture:
    """Return the picture of a chain's path: outlines of evenly spaced states over the image of the first camera that saw the frame."""
    session = inspection.run.session
    model = seen_in(inspection.run.settled_model, session, frame)
    (block,) = pose_blocks(inspection.run.tree, range(frame, frame + 1), variable=model.body.variable)
    chain = by_chain(block.poses[:1], mixing.length)[0, 0, :, 0]
    shown = _camera(inspection, frame)
    image, _ = run_backdrop(inspection.run, frame, shown)
    chosen = np.unique(np.linspace(0, len(chain) - 1, STATES).round().astype(int))
    thin = max(1, round(image.shape[1] / 900))
    inks = cv2.applyColorMap(np.linspace(255, 60, len(chosen)).astype(np.uint8)[:, None], cv2.COLORMAP_PLASMA)[:, 0]
    drawn = [outlines(model, chain[step])[shown] for step in chosen]
    for parts, ink in zip(drawn, inks, strict=True):
        for outline in parts:
            points = np.round(outline.polygon * 16).astype(np.int32)
            cv2.polylines(image, [points], True, tuple(int(c) for c in ink), thin, cv2.LINE_AA, shift=4)
    polygons = [outline.polygon for parts in drawn for outline in parts]
    corners = np.concatenate(polygons) if polygons else np.zeros((0, 2))
    picture = crop_about(corners, (image.shape[1], image.shape[0]), WIDEST).cut(image)
    name = session.views[shown].camera.name
    caption = f"Camera {name}, frame {inspection.number(frame)}: {len(chosen)} of {len(chain)} states of a chain."
    alt = f"Path of a chain over frame {inspection.number(frame)} of camera {name}."
    return Picture(webp_uri(picture, QUALITY), alt, caption, inverts=False)


def _camera(inspection: Inspection, frame: int) -> int:
    visibility = inspection.diagnosis.seen
    return int(visibility[frame].argmax()) if visibility is not None and visibility[frame].any() else 0
