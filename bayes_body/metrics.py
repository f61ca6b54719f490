"""How good a run is: overlap with the silhouettes, agreement of the runs, and the figures of `summary.json`."""

import resource
import sys
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from bayes_body.observation.frames import read_frame
from bayes_body.posterior import markers, mean_poses, rhat
from bayes_body.session import Session
from bayes_body.tracking import Draws
from bayes_body.view.progress import Watch, unwatched
from bayes_body.view.silhouette import intersection_over_union, projected_masks


def silhouette_overlap(session: Session, draws: Draws, watch: Watch = unwatched) -> Float[np.ndarray, "run frame camera"]:
    """Overlap of the projected mean body of each run with the silhouettes; NaN where the session has none."""
    poses = mean_poses(draws)
    runs, frames = poses.shape[:2]
    out = np.full((runs, frames, len(session.views)), np.nan)
    for frame in watch(range(frames)):
        seen = read_frame(session, frame).masks
        if seen is None:
            return out
        for run in range(runs):
            projected = projected_masks(draws.model, poses[run, frame], session)
            out[run, frame] = [intersection_over_union(a, b) for a, b in zip(projected, seen, strict=True)]
    return out


def marker_disagreement(draws: Draws) -> float:
    """Mean distance between the runs' mean markers: over pairs of runs, frames and markers, metres; NaN with a single run."""
    positions = markers(draws.model, mean_poses(draws))
    runs = positions.shape[0]
    pairs = [np.linalg.norm(positions[a] - positions[b], axis=-1).mean() for a in range(runs) for b in range(a)]
    return float(np.mean(pairs)) if pairs else float("nan")


def lost_frames(draws: Draws) -> str:
    """Which frames were lost, and what to do, in a sentence; runs of frames as `7-9`."""
    ranges: list[list[int]] = []
    for frame in draws.frames_lost:
        if ranges and ranges[-1][1] == frame - 1:
            ranges[-1][1] = frame
        else:
            ranges.append([frame, frame])
    named = ", ".join(str(first) if first == last else f"{first}-{last}" for first, last in ranges)
    return f"lost        frames {named}: no particle explained them, the filter went on from its prediction; look at the images, or raise --particles"


def log_evidence(draws: Draws) -> float:
    """log p(all images), up to the likelihood's constant: the runs' estimates averaged before the logarithm; NaN from a mode seeker."""
    by_run = np.asarray(draws.info.log_evidence, float).sum(axis=1)
    if np.isnan(by_run).any():
        return float("nan")
    return float(np.logaddexp.reduce(by_run) - np.log(len(by_run)))


def summarise(session: Session, draws: Draws, *, kernel: str, layers: int, seed: int, watch: Watch = unwatched) -> dict[str, Any]:
    """The stable keys of `summary.json`; a figure that does not exist is null.

    Seconds are wall-clock, all runs together; `seconds_per_frame` and `evaluations_per_second` leave the compilation out. An evaluation is the
    likelihood of a whole pose over all cameras.
    """
    runs, frames, particles = draws.log_weights.shape
    working = draws.timing.total - draws.timing.compile
    ess = np.asarray(draws.info.ess)
    worst = rhat(draws)
    overlap = silhouette_overlap(session, draws, watch)
    figures = {
        "frames": frames,
        "frames_lost": len(draws.frames_lost),
        "cameras": len(session.views),
        "dof": len(draws.model.body.dof_names),
        "particles": particles,
        "layers": layers,
        "runs": runs,
        "kernel": kernel,
        "model": draws.model.definition.name,
        "seed": seed,
        "seconds_total": draws.timing.total,
        "seconds_compile": draws.timing.compile,
        "seconds_per_frame": working / frames,
        "evaluations_per_second": runs * frames * particles * layers / working,
        "peak_memory_mb": peak_memory_mb(),
        "ess_min": float(ess.min()),
        "ess_median": float(np.median(ess)),
        "rhat_max": _largest(worst),
        "log_evidence": log_evidence(draws),
        "iou_median": float(np.nanmedian(overlap)) if np.isfinite(overlap).any() else None,
        "marker_disagreement_mm": 1000 * marker_disagreement(draws),
    }
    return {key: None if isinstance(value, float) and not np.isfinite(value) else value for key, value in figures.items()}


def _largest(values: NDArray[np.floating]) -> float | None:
    finite = values[np.isfinite(values)]
    return float(finite.max()) if finite.size else None


def peak_memory_mb() -> float:
    """The most memory that this process has held, in 10⁶ bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    # Kilobytes on Linux, bytes on macOS.
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6
