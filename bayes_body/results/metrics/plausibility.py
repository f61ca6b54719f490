"""The judge of plausibility: whether a body can be on the person at all, and the sentences about it.

A frame is judged by the keypoints if there are any, else by the silhouettes. In any case, a body that no camera can see is off the person, and so is
one that lies beside the silhouettes of all cameras.

The limits come from the demonstration and the PARSEC recording (four cameras each). The cover of good poses is 0.90 to 0.97 in every camera. For a
body that is 0.1 m off it is 0.66 to 0.87, median 0.79; for one that is 0.2 m off 0.43 to 0.71, median 0.60; for one at the origin 0.00 to 0.49.
A small body inside a large silhouette has a cover of 1. So a whole body must also overlap (IoU) with the silhouettes; good poses do so by 0.6 or
more.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from bayes_body.base.errors import InputError, input_error
from bayes_body.initial.fitting.outline import LEAST_OVERLAP
from bayes_body.model.build import Model
from bayes_body.recording.observation.frames import read_frame
from bayes_body.recording.session.session import Session
from bayes_body.results.metrics.fit import Fit, distance_from_bystanders, frame_fit, silhouette_shares

# The body is not on the person if the median over the cameras of the cover is below the first, or that of the distance (as a fraction of the
# person's size) is above the second.
LEAST_COVER, MOST_DISTANCE = 0.7, 0.2
# A body whose cover is below this in every camera lies beside the person, whatever its keypoints say.
BESIDE = 0.05
# Shares of an image that a person's silhouette can cover. Outside of them it is empty, or it is the background.
SILHOUETTE = (1e-4, 0.6)
# Number of consecutive frames that a warning needs: a single bad silhouette gives no warning.
FEWEST_FRAMES = 3


class Verdict(NamedTuple):
    """The figures of a frame, median over the cameras, and what follows from them. A figure that does not exist is NaN.

    Of all frames of a run, each field has a leading axis (frame,).

    Attributes:
        cover: of the cameras whose silhouette can be a person's.
        overlap: of the same cameras, for a whole body.
        distance: from the keypoints.
        outside: whether the body is outside of all images.
        beside: whether the body lies beside the silhouettes of all these cameras.
        off: whether the body is not on the person; False where nothing tells.
        blind: whether there are silhouettes, none can be a person's, and nothing else tells.
    """

    cover: Float[np.ndarray, " run"]
    overlap: Float[np.ndarray, " run"]
    distance: Float[np.ndarray, " run"]
    outside: Bool[np.ndarray, " run"]
    beside: Bool[np.ndarray, " run"]
    off: Bool[np.ndarray, " run"]
    blind: Bool[np.ndarray, ""]


def judge(fit: Fit) -> Verdict:
    """Judge the fit of a frame."""
    usable = can_be_a_person(fit.silhouette)
    cover, overlap = (_over_cameras(np.where(usable, values, np.nan)) for values in (fit.cover, fit.overlap))
    overlap, distance = overlap if fit.is_whole else np.full_like(overlap, np.nan), _over_cameras(fit.distance)
    outside = (fit.body == 0).all(axis=-1)
    beside = usable.any() & ~outside & (~usable | (fit.cover < BESIDE)).all(axis=-1)
    by_keypoints = bool(np.isfinite(distance).any())
    # A comparison with NaN is False: nothing is said where nothing tells.
    off = distance > MOST_DISTANCE if by_keypoints else (cover < LEAST_COVER) | (overlap < LEAST_OVERLAP)
    blind = not by_keypoints and bool(np.isfinite(fit.silhouette).any()) and not usable.any()
    return Verdict(cover, overlap, distance, outside, beside, off | outside | beside, np.asarray(bool(blind)))


def can_be_a_person(shares: Float[np.ndarray, " camera"]) -> Bool[np.ndarray, " camera"]:
    """Return whether silhouettes that cover these shares of their images can be a person's; False for NaN."""
    return (shares >= SILHOUETTE[0]) & (shares <= SILHOUETTE[1])


def check_silhouettes(session: Session, model: Model) -> None:
    """Check that the silhouettes of frame 0 can be a person's, if a likelihood of the model compares the body with silhouettes.

    Raises:
        InputError: every camera's silhouette is empty or covers most of the image, or a file of frame 0 cannot be used.
    """
    if not model.reads_pictures:
        return
    frame = read_frame(session, 0)
    if frame.masks is None:
        return
    shares = silhouette_shares(frame)
    if np.isnan(shares).all() or can_be_a_person(shares).any():
        return
    try:
        model.observe(frame._replace(masks=None, foreground=None))
    except InputError:
        problem = f"in frame {session.first_frame} no camera's silhouette can be a person's: they cover {_listed(100 * shares)} % of the images"
        expected = f"{100 * SILHOUETTE[0]:g} to {100 * SILHOUETTE[1]:g} % in one camera or more; a person is white in `masks`, all else black"
        remedy = "correct `masks` (are they inverted?) or `background`, or begin at a frame that shows the person"
        raise input_error("session.toml", problem, expected, remedy) from None


def check_view(session: Session, model: Model) -> None:
    """Check that a camera can see the body in its first pose.

    Raises:
        InputError: the body is behind every camera or outside of its image, or a file of frame 0 cannot be used.
    """
    if judge(_first(session, model)).outside.any():
        problem = "the body in its first pose is behind every camera or outside of its image"
        expected = f"a first pose that a camera sees in frame {session.first_frame}"
        remedy = "check the calibration, the units (metres) and the positions under [initial], or remove [initial] to look for the person"
        raise input_error("session.toml: initial", problem, expected, remedy)


def _listed(percent: Float[np.ndarray, " camera"]) -> str:
    return ", ".join(f"{share:.3g}" for share in percent[np.isfinite(percent)])


def is_off(fit: Fit) -> Bool[np.ndarray, " run"]:
    """Return whether each run's body is off the person; False where nothing tells."""
    return judge(fit).off


def first_fit(session: Session, model: Model) -> dict[str, Any]:
    """Return the fit of the model's first pose to frame 0: `fit_by`, `fit_first`, `overlap_first` and `first_frame` of `summary.json`.

    If the pose is on another person than the one that is tracked, `fit_bystander` is its distance from that person's keypoints.
    """
    verdict = judge(_first(session, model))
    figures = _first_figures(verdict, bool(np.isfinite(verdict.distance).any())) | {"first_frame": session.first_frame}
    if verdict.distance[0] > MOST_DISTANCE:
        distances = distance_from_bystanders(session, model, np.asarray(model.initial[model.body.variable], float), 0)
        distance = float(_over_cameras(distances[None])[0])
        figures |= {"fit_bystander": distance} if distance <= MOST_DISTANCE else {}
    return figures


def _first(session: Session, model: Model) -> Fit:
    return frame_fit(session, model, np.asarray(model.initial[model.body.variable], float)[None], 0, to_judge=True)


def _first_figures(first: Verdict, by_keypoints: bool) -> dict[str, Any]:
    value = float((first.distance if by_keypoints else first.cover)[0])
    overlap = float(first.overlap[0])
    is_judged = bool(np.isfinite(value))
    return {
        "fit_by": ("keypoints" if by_keypoints else "silhouettes") if is_judged else None,
        "fit_first": value if is_judged else None,
        "overlap_first": overlap if np.isfinite(overlap) and not by_keypoints else None,
    }


def fit_figures(first: Fit, verdicts: Verdict, first_frame: int = 0) -> dict[str, Any]:
    """Return the keys of `summary.json` about the fit; by keypoints if there are any, else by silhouettes.

    Args:
        first: fit of the first pose to frame 0.
        verdicts: of the fit of each run's mean pose to each frame, with a leading axis (frame,).
        first_frame: number of the first frame in the recording.
    """
    by_keypoints = bool(np.isfinite(verdicts.distance).any())
    worst, frame = _worst(verdicts.distance if by_keypoints else -verdicts.cover)
    least, least_frame = _worst(-verdicts.overlap) if not by_keypoints else (None, None)
    return _first_figures(judge(first), by_keypoints) | {
        "fit_by": ("keypoints" if by_keypoints else "silhouettes") if worst is not None else None,
        "fit_worst": worst if worst is None or by_keypoints else -worst,
        "fit_worst_frame": None if frame is None else first_frame + frame,
        "overlap_worst": None if least is None else -least,
        "overlap_worst_frame": None if least_frame is None else first_frame + least_frame,
        "frames_off": _lasting(verdicts.off.any(axis=1), first_frame),
        "frames_outside": _lasting(verdicts.outside.any(axis=1), first_frame),
        "frames_beside": _lasting(verdicts.beside.any(axis=1), first_frame),
        "frames_blind": _lasting(verdicts.blind, first_frame),
    }


def _worst(values: Float[np.ndarray, "frame run"]) -> tuple[float | None, int | None]:
    """Return the largest value and its frame; None if there is none."""
    by_frame = np.where(np.isfinite(values), values, -np.inf).max(axis=1)
    frame = int(by_frame.argmax())
    return (float(by_frame[frame]), frame) if np.isfinite(by_frame[frame]) else (None, None)


def _over_cameras(values: Float[np.ndarray, "run camera"]) -> Float[np.ndarray, " run"]:
    """Return the median over the cameras that have a value; NaN if none has."""
    return np.array([np.median(row[np.isfinite(row)]) if np.isfinite(row).any() else np.nan for row in values])


def _lasting(crossed: Bool[np.ndarray, " frame"], first_frame: int) -> list[int]:
    """Return the numbers of the frames of stretches of at least FEWEST_FRAMES frames, or of all frames if there are fewer."""
    least, edges = min(FEWEST_FRAMES, len(crossed)), np.flatnonzero(np.diff(np.concatenate([[0], crossed.astype(int), [0]]))).reshape(-1, 2)
    return [first_frame + frame for start, stop in edges.tolist() if stop - start >= least for frame in range(start, stop)]
