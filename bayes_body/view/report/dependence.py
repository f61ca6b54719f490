r"""Which dofs depend on each other in the posterior: correlations of the weighted draws of a frame, and the posterior of a shoulder's angles.

Correlations are those within a run, $r = S_{jk} / \sqrt{S_{jj} S_{kk}}$ with S the mean of the runs' weighted covariances. Runs that found different
poses therefore do not make dofs look dependent. With few effective draws n, large correlations occur by chance. Pairs are ordered by the adjusted
square $1 - (1 - r^2)(n - 1) / (n - 2)$, whose mean is about 0 for independent dofs.

The log posterior of a shoulder's three angles is shown over the frames (Sidenbladh, Black & Fleet 2000, Fig. 4). Bands would hide that a posterior
has several modes or fills a whole range, as that of a straight arm's twist does.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.results.posterior.blocks import coordinate_blocks, pooled, weights_of_runs
from bayes_body.view.colours import SEQUENTIAL
from bayes_body.view.report.figures import encoded, frames_a_point, new_panel, set_margins, time_axis, time_label
from bayes_body.view.report.inspection import Inspection, spoken
from bayes_body.view.report.markup import Markup, Picture, details, figures, tag

# Number of pairs in the table, and of dofs in the plot.
PAIRS, DOFS = 6, 5
# A pair with a smaller correlation is not shown. A frame with fewer effective draws is not chosen if there is another.
LEAST, FEWEST = 0.3, 30
# A dof that moves less than this, radians or metres, does not move.
STILL = 1e-6


class Dependence(NamedTuple):
    """The dofs that depend most on each other, in the frame with the strongest dependence.

    Attributes:
        frame: the frame.
        pairs: pairs of dofs with a correlation of at least LEAST, strongest first, at most PAIRS.
        dofs: the dofs of the strongest pairs that fit into DOFS, in the body's order.
        correlations: of all dofs at the frames of `Inspection.frames`; NaN for a dof that does not move.
        place: the frame's index in `correlations`.
    """

    frame: int
    pairs: Sequence[tuple[int, int]]
    dofs: Sequence[int]
    correlations: Float[np.ndarray, "frame dof dof"]
    place: int


def dependence(inspection: Inspection) -> Dependence:
    """Return the strongest dependence of a run's posterior; without pairs if there is none."""
    blocks = coordinate_blocks(inspection.run.tree, inspection.frames, spaces=inspection.run.spaces)
    matrices = np.concatenate([correlations(block.poses, weights_of_runs(block.log_weights)) for block in blocks])
    effective = inspection.diagnosis.ess[:, list(inspection.frames)].sum(axis=0)
    upper = np.triu_indices(matrices.shape[1], 1)
    squares = np.nan_to_num(adjusted(matrices[:, *upper], effective[:, None]), nan=-np.inf)
    place = chosen_place(squares, effective)
    order = np.argsort(-squares[place], kind="stable")
    strong = [
        (int(upper[0][k]), int(upper[1][k])) for k in order if squares[place, k] > 0 and abs(matrices[place, upper[0][k], upper[1][k]]) >= LEAST
    ]
    return Dependence(inspection.frames[place], strong[:PAIRS], chosen_dofs(strong), matrices, place)


def correlations(poses: Float[np.ndarray, "run draw frame dof"], weights: Float[np.ndarray, "run draw frame"]) -> Float[np.ndarray, "frame dof dof"]:
    """Return the correlations within the runs; NaN for a dof that does not move.

    Args:
        poses: draws, radians and metres.
        weights: with the sum 1 in each run and frame.
    """
    off = poses - np.einsum("rdf,rdfk->rfk", weights, poses)[:, None]
    covariance = np.stack(
        [np.mean([(w[:, None] * o).T @ o for w, o in zip(weights[..., f], off[:, :, f], strict=True)], axis=0) for f in range(poses.shape[2])]
    )
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    sd = np.where(sd > STILL, sd, np.nan)
    return np.clip(covariance / (sd[:, :, None] * sd[:, None, :]), -1, 1)


def adjusted(r: Float[np.ndarray, "frame pair"], effective: Float[np.ndarray, "frame 1"]) -> Float[np.ndarray, "frame pair"]:
    """Return r² without the part that chance explains, for that number of effective draws."""
    count = np.maximum(effective, 3.0)
    return 1 - (1 - r**2) * (count - 1) / (count - 2)


def chosen_place(squares: Float[np.ndarray, "frame pair"], effective: Float[np.ndarray, " frame"]) -> int:
    """Return the index of the frame whose strongest PAIRS pairs have the largest mean adjusted square, among frames with FEWEST effective draws."""
    strongest = np.sort(np.maximum(squares, 0), axis=1)[:, -PAIRS:].sum(axis=1)
    has_enough = effective >= min(FEWEST, effective.max())
    return int(np.where(has_enough, strongest, -1.0).argmax())


def chosen_dofs(pairs: Sequence[tuple[int, int]]) -> list[int]:
    """Return the dofs of the pairs, at most DOFS; a pair that no longer fits is left out. Pairs are given strongest first."""
    chosen: set[int] = set()
    for pair in pairs:
        if len(chosen | set(pair)) <= DOFS:
            chosen |= set(pair)
    return sorted(chosen)


SHOULDER, BINS = "shoulder", 60
# Fainter than the frame's mode by more than this, in natural logarithms, is white.
FAINTEST = 6.0
LEGEND = "How probable each angle is in each frame: the natural logarithm of the posterior, relative to the most probable angle. All runs together."


def density_details(inspection: Inspection) -> Markup | None:
    """Return the panels of every shoulder's angles; None if the body has none, or if the spread of the particles means nothing."""
    places = [place for place, name in enumerate(inspection.dofs) if SHOULDER in name and inspection.units[place] == "°"]
    if not places or inspection.diagnosis.mode_seeker:
        return None
    frames = range(0, inspection.run.frames, frames_a_point(inspection.run.frames))
    blocks = list(coordinate_blocks(inspection.run.tree, frames, spaces=inspection.run.spaces))
    weights = np.concatenate([pooled(weights_of_runs(piece.log_weights)) / piece.poses.shape[0] for piece in blocks])
    angles = np.degrees(np.concatenate([pooled(piece.poses)[..., places] for piece in blocks]))
    label = time_label(inspection.fps)
    panels = figures(
        _panel(inspection, inspection.dofs[place], frames, log_density(angles[..., k], weights), label) for k, place in enumerate(places)
    )
    return details("Log posterior of the shoulders' angles", tag("p", LEGEND), panels)


class LogDensity(NamedTuple):
    """The log-density relative to each frame's largest, in bins from `low` to `high`, degrees."""

    values: Float[np.ndarray, "bin frame"]
    low: float
    high: float


def log_density(angles: Float[np.ndarray, "frame draw"], weights: Float[np.ndarray, "frame draw"]) -> LogDensity:
    """Return the histogram of weighted angles in each frame, as logarithms; bins without weight are -inf."""
    low, high = float(angles.min()), float(angles.max())
    margin = max(1.0 - (high - low) / 2, 0.0)
    low, high = low - margin, high + margin
    bins = np.minimum(((angles - low) / (high - low) * BINS).astype(int), BINS - 1)
    mass = np.zeros((BINS, len(angles)))
    np.add.at(mass, (bins, np.arange(len(angles))[:, None]), weights)
    with np.errstate(divide="ignore"):
        return LogDensity(np.log(mass) - np.log(mass.max(axis=0)), low, high)


def _panel(inspection: Inspection, name: str, frames: range, density: LogDensity, label: str) -> Picture:
    values, low, high = density
    figure, axes = new_panel(spoken(name), label, "angle, degrees", (3.6, 2.3))
    set_margins(figure, 0.66, 0.42)
    axes.grid(visible=False)
    last = frames[-1] + frames.step / 2
    shown = axes.imshow(
        np.maximum(values, -FAINTEST),
        extent=(-frames.step / 2, last, low, high),
        origin="lower",
        aspect="auto",
        interpolation="nearest",
        cmap=SEQUENTIAL,
        vmin=-FAINTEST,
        vmax=0,
    )
    time_axis(axes, inspection.run.frames, inspection.fps)
    figure.colorbar(shown, ax=axes, pad=0.03, ticks=[-FAINTEST, -FAINTEST / 2, 0])
    return encoded(figure, f"Log posterior of {spoken(name)} over the frames, angles from {low:.0f} to {high:.0f} degrees.")
