"""How well a person is found in single frames, compared with the truth: the errors of Sigal et al. 2011, section 9, and how many are turned round.

The error of a frame is the mean distance of the found markers from the true ones. A person is turned round if the line from the right hip to the left
one points more than 90 degrees away from the true one. That is counted twice: for what each frame says alone, and for what it says with its
neighbours (initial/search/search.py). The error is that of the latter.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from error_plot import LIMITS_M
from jaxtyping import Bool, Float

from bayes_body.base.progress import Watch, unwatched
from bayes_body.initial.detection.detect import Detected
from bayes_body.initial.search.person_search import Found, PersonSearch
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.session.session import Session
from bayes_body.results.metrics.truth import draws_against_truth, true_markers
from bayes_body.results.posterior import markers, mean_pose
from bayes_body.tracking.draws import Draws


class SingleFrames(NamedTuple):
    """People found in some frames; NaN and False where nobody was found or no truth is known.

    Attributes:
        frames: the frames.
        error_m: mean distance of the markers from the true ones, metres.
        error_alone_m: the same, for what each frame says alone.
        turned: whether the found person is turned round.
        turned_alone: the same, for what each frame says alone.
        sd_m: what the search says of its error, metres.
        seconds: by detector and for the search, seconds.
    """

    frames: tuple[int, ...]
    error_m: Float[np.ndarray, " frame"]
    error_alone_m: Float[np.ndarray, " frame"]
    turned: Bool[np.ndarray, " frame"]
    turned_alone: Bool[np.ndarray, " frame"]
    sd_m: Float[np.ndarray, " frame"]
    seconds: dict[str, Float[np.ndarray, " frame"]]

    def figures(self) -> dict[str, Any]:
        """Return `error_figures`, those of the facing and of the time; `shares` are of the time, `found` counts frames with a person."""
        times = {name: float(np.nansum(durations)) for name, durations in self.seconds.items()}
        total = sum(times.values())
        known = np.isfinite(self.error_m)
        return {
            **error_figures(self.error_m),
            "median_alone_mm": 1000 * float(np.median(self.error_alone_m[known])) if known.any() else None,
            "flips": float(self.turned[known].mean()) if known.any() else None,
            "flips_alone": float(self.turned_alone[known].mean()) if known.any() else None,
            "found": int(np.isfinite(self.sd_m).sum()),
            "errors_mm": _listed(self.error_m),
            "turned_frames": [frame for frame, turned in zip(self.frames, self.turned, strict=True) if turned],
            "seconds_per_frame": total / len(self.frames),
            "shares": {name: seconds / total for name, seconds in times.items()},
        }


def single_frames(search: PersonSearch, frames: Sequence[int], watch: Watch = unwatched) -> SingleFrames:
    """Search frames of a session, and compare what is found with the session's truth.

    Args:
        search: the search.
        frames: the frames, counted from 0.
        watch: wraps the frames to show progress.

    Raises:
        InputError: there is no such frame, or a file of the session cannot be used.
    """
    truth = true_markers(search.session)
    rows, seconds = [], []
    for frame in watch(frames):
        together, alone = search.window(frame), search.frame(frame)
        true = None if truth is None else truth[frame]
        rows.append([*_compared(together, true), *_compared(alone, true), together.sd_m if isinstance(together, Found) else np.nan])
        seconds.append(together.seconds)
    error, turned, error_alone, turned_alone, sd = np.array(rows, float).T
    names = list(dict.fromkeys(name for durations in seconds for name in durations))
    by_name = {name: np.array([durations.get(name, np.nan) for durations in seconds]) for name in names}
    return SingleFrames(tuple(frames), error, error_alone, turned > 0, turned_alone > 0, sd, by_name)


def _compared(detection: Found | Detected, true: Float[np.ndarray, "15 3"] | None) -> tuple[float, bool]:
    """Return the mean distance of the found markers from the true ones, and whether the person is turned round."""
    if true is None or isinstance(detection, Detected):
        return float("nan"), False
    places = detection.markers[[detection.names.index(name) for name in MARKERS]]
    return float(np.nanmean(np.linalg.norm(places - true, axis=1))), bool(_is_turned(places, true))


def _is_turned(places: Float[np.ndarray, "*of 15 3"], true: Float[np.ndarray, "15 3"]) -> Bool[np.ndarray, "*of"]:
    """Whether people whose markers are at these places are turned round; False where the true hips are unknown."""
    left, right = MARKERS.index("l_hip"), MARKERS.index("r_hip")
    return np.asarray((places[..., left, :] - places[..., right, :]) @ (true[left] - true[right]) < 0)


def track_figures(session: Session, draws: Draws) -> tuple[dict[str, Any], Float[np.ndarray, " frame"]]:
    """Return the figures of a track, as `SingleFrames.figures` has them, and the error of each frame, metres, mean over the runs.

    `flips` is the share of the frames and runs in which the mean body is turned round; None without a truth, or if the body lacks markers.

    Raises:
        InputError: the session's truth cannot be used.
    """
    against, working = draws_against_truth(session, draws), draws.timing.total - draws.timing.compile
    error = np.full(len(draws.frames), np.nan) if against is None else against.plain.frame_error.mean(axis=1)
    turned = _turned_of(session, draws)
    figures = {
        **error_figures(error),
        "flips": None if turned is None else float(turned.mean()),
        "errors_mm": _listed(error),
        "turned_frames": [] if turned is None else np.flatnonzero(turned.any(axis=1)).tolist(),
        "frames_lost": len(draws.frames_lost),
        "frames_restarted": draws.frames_restarted,
        "seconds_per_frame": working / len(draws.frames),
    }
    return figures, error


def _turned_of(session: Session, draws: Draws) -> Bool[np.ndarray, "frame run"] | None:
    truth, names = true_markers(session), draws.model.body.markers.names
    if truth is None or not set(MARKERS) <= set(names):
        return None
    order = [names.index(name) for name in MARKERS]
    means = [markers(draws.model, mean_pose(frame, draws.model))[:, order] for frame in draws.frames]
    return np.stack([_is_turned(mean, true) for mean, true in zip(means, truth, strict=False)])


def _listed(error_m: Float[np.ndarray, " frame"]) -> list[float | None]:
    """Errors in millimetres, to a tenth; None where there is none."""
    return [round(1000 * float(error), 1) if np.isfinite(error) else None for error in error_m]


def error_figures(error_m: Float[np.ndarray, " frame"]) -> dict[str, Any]:
    """Return the figures of the paper's Table 3, in millimetres; a figure that does not exist is None.

    `under_80` and `under_120` are shares of all frames; a frame in which nobody was found counts as one with a larger error.
    """
    known = error_m[np.isfinite(error_m)]
    moments = {"median_mm": np.median, "mean_mm": np.mean, "sd_mm": np.std}
    figures: dict[str, Any] = {name: 1000 * float(moment(known)) if known.size else None for name, moment in moments.items()}
    limits = {f"under_{1000 * limit:.0f}": float((error_m < limit).mean()) if known.size else None for limit in LIMITS_M.values()}
    return figures | limits | {"frames": len(error_m)}
