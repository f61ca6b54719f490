"""Agreement of the runs, evidence, and the figures of `summary.json`.

Frames are read one at a time, and only a few numbers of each are kept. The figure at the head of a run measures the fit to the data that the run was
fitted to.
"""

import resource
import sys
from collections.abc import Mapping
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from bayes_body.base.progress import Watch, unwatched
from bayes_body.base.registry import OTHER
from bayes_body.model.body.solids import configuration_space
from bayes_body.model.build import Model
from bayes_body.recording.session.session import Session
from bayes_body.results.metrics.by_frame import stack_frames
from bayes_body.results.metrics.figures import accuracy_figures
from bayes_body.results.metrics.fit import frame_fit, result_fit
from bayes_body.results.metrics.plausibility import Verdict, fit_figures, judge
from bayes_body.results.metrics.truth import draws_against_truth
from bayes_body.results.metrics.unknowns import near_limit_shares, near_limits, unknown_figures
from bayes_body.results.posterior import frame_rhat, markers
from bayes_body.results.posterior.blocks import log_mean_exp
from bayes_body.results.posterior.weighted import mean_state
from bayes_body.tracking.draws import Draws, FrameResult


def marker_disagreement(draws: Draws) -> float:
    """Return the mean distance between the runs' mean markers, over pairs of runs, frames and markers, metres; NaN with a single run."""
    return float(np.mean([_disagreement(draws.model, frame) for frame in draws.frames]))


def _disagreement(model: Model, frame: FrameResult) -> float:
    means = mean_state(frame, model)
    positions = markers(model, means.pop(model.body.variable), **means)
    pairs = [np.linalg.norm(a - b, axis=-1).mean() for a, b in combinations(positions, 2)]
    return float(np.mean(pairs)) if pairs else float("nan")


def log_evidence(draws: Draws) -> float:
    """Return log p(all images), up to the likelihood's constant; NaN for a mode seeker. The runs' estimates are averaged before the logarithm."""
    return log_mean_exp(sum((np.asarray(frame.info.log_evidence, float) for frame in draws.frames), np.zeros(draws.runs)))


class _Figures(NamedTuple):
    """The figures of one frame for the summary, or of all frames with a leading axis (frame,).

    Arrays (run,), single numbers, the fit (run, camera), its verdict, and whether each dof is near its limit.
    """

    ess: NDArray[Any]
    layers: NDArray[Any]
    log_evidence: NDArray[Any]
    evaluations: NDArray[Any]
    lost: NDArray[Any]
    restarted: NDArray[Any]
    rhat: NDArray[Any]
    overlap: NDArray[Any]
    distance_px: NDArray[Any]
    verdict: Verdict
    disagreement: NDArray[Any]
    near_limits: NDArray[Any]


def _figures(session: Session, model: Model, frame: FrameResult, index: int, to_judge: bool) -> _Figures:
    info, fit = frame.info, result_fit(session, model, frame, index, to_judge)
    worst = _largest(frame_rhat(frame, index, model.body.variable, configuration_space(model.body)))
    # A kernel that chooses its number of layers fills the unused layers with NaN.
    layers = np.isfinite(info.inverse_temperatures).sum(axis=-1)
    return _Figures(
        ess=np.asarray(info.ess),
        layers=layers,
        log_evidence=np.asarray(info.log_evidence, float),
        evaluations=np.asarray(np.sum(info.evaluations, dtype=np.int64)),
        lost=np.asarray(frame.lost),
        restarted=np.asarray(frame.restarted.any()),
        rhat=np.asarray(worst),
        overlap=fit.overlap,
        distance_px=fit.distance_px,
        verdict=judge(fit),
        disagreement=np.asarray(_disagreement(model, frame)),
        near_limits=near_limits(model, frame),
    )


def summarise(session: Session, draws: Draws, *, kernel: str, seed: int, watch: Watch = unwatched, pictures: bool = True) -> dict[str, Any]:
    """Return the stable keys of `summary.json`; a figure that does not exist is null. Frames are numbers in the recording.

    Seconds are wall-clock time of all runs together; `seconds_per_frame` and `evaluations_per_second` exclude the compilation. An evaluation is the
    likelihood of a whole pose over all cameras. Without `pictures`, a model that reads only keypoints is not compared with silhouettes.
    """
    frames, working = len(draws.frames), draws.timing.total - draws.timing.compile
    to_judge = not pictures and not draws.model.reads_pictures
    by_frame = stack_frames(_figures(session, draws.model, draws.frames[index], index, to_judge) for index in watch(range(frames)))
    mode_seeker = not draws.samples_posterior
    first = frame_fit(session, draws.model, np.asarray(draws.model.initial[draws.model.body.variable], float)[None], 0, to_judge=to_judge)
    figures = {
        "frames": frames,
        "first_frame": draws.first_frame,
        "frames_lost": int(by_frame.lost.sum()),
        "frames_restarted": (draws.first_frame + np.flatnonzero(by_frame.restarted)).tolist(),
        "cameras": len(session.views),
        "dof": configuration_space(draws.model.body).dimension,
        "particles": draws.particles,
        "layers": round(float(np.median(by_frame.layers))),
        "runs": draws.runs,
        "kernel": kernel,
        "model": draws.model.definition.name,
        "seed": seed,
        "seconds_total": draws.timing.total,
        "seconds_compile": draws.timing.compile,
        "seconds_per_frame": working / frames,
        "evaluations_per_second": int(by_frame.evaluations.sum()) / working,
        "peak_memory_mb": peak_memory_mb(),
        "ess_min": float(by_frame.ess.min()),
        "ess_median": float(np.median(by_frame.ess)),
        "rhat_max": _largest(by_frame.rhat),
        "log_evidence": log_mean_exp(by_frame.log_evidence.sum(axis=0)),
        "reads": draws.model.reads,
        "iou_median": _median(by_frame.overlap),
        "reprojection_px_median": _median(by_frame.distance_px),
        "reprojection_by_camera": _by_camera(session, by_frame.distance_px),
        "marker_disagreement_mm": 1000 * float(by_frame.disagreement.mean()),
        **fit_figures(first, by_frame.verdict, draws.first_frame),
        **unknown_figures(draws.model, draws.frames[frames - 1], frames - 1, not mode_seeker),
        "near_limit_shares": near_limit_shares(draws.model, None if mode_seeker else by_frame.near_limits),
        **accuracy_figures(draws_against_truth(session, draws, watch), mode_seeker),
    }
    return {key: None if isinstance(value, float) and not np.isfinite(value) else value for key, value in figures.items()}


def _by_camera(session: Session, distance_px: Float[np.ndarray, "frame run camera"]) -> dict[str, dict[str, float]]:
    """Return the median distance of each camera that has keypoints, in pixels and as a share of the image's diagonal."""
    medians = {view.camera.name: _median(distance_px[..., c]) for c, view in enumerate(session.views)}
    diagonals = {view.camera.name: float(np.hypot(*view.camera.size_px)) for view in session.views}
    return {name: {"px": px, "of_diagonal": px / diagonals[name]} for name, px in medians.items() if px is not None}


def _median(values: NDArray[np.floating]) -> float | None:
    """Return the median of what is known; None if nothing is."""
    return float(np.nanmedian(values)) if np.isfinite(values).any() else None


def _largest(values: NDArray[np.floating]) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.max()) if finite.size else float("nan")


def peak_memory_mb() -> float:
    """Return the peak memory of this process, in 10⁶ bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    # Kilobytes on Linux, bytes on macOS.
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6


def shows_overlap(summary: Mapping[str, Any]) -> bool:
    """Return whether the overlap with the silhouettes says how well a run fits: it was fitted to them, or it is unknown to what it was."""
    reads = summary.get("reads")
    return reads is None or not {"silhouettes", OTHER}.isdisjoint(reads)


def shows_reprojection(summary: Mapping[str, Any]) -> bool:
    """Return whether the run was fitted to keypoints and has their reprojection error."""
    return "keypoints" in (summary.get("reads") or ()) and summary.get("reprojection_px_median") is not None
