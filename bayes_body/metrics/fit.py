r"""Fit of the projected mean body to a frame, measured by the silhouettes or by the keypoints.

With A the body's projection and B the silhouette, the overlap is $|A \cap B| / |A \cup B|$ (IoU) and the cover is
$|A \cap B| / \min(|A|, |B|)$. The cover stays near 1 if the body is only a part of the person, such as two legs, or if clothes or a shadow enlarge
the silhouette. It falls if the two lie apart. The distance to the keypoints is the median over the body's markers, divided by the person's size in
the image (the larger side of the box around the keypoints).

The limits come from the demonstration and the PARSEC recording (four cameras each). The cover of good poses is 0.90 to 0.97 in every camera. For a
body that is 0.1 m off it is 0.66 to 0.87, median 0.79; for one that is 0.2 m off 0.43 to 0.71, median 0.60; for one at the origin 0.00 to 0.49.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from bayes_body.geometry.camera import Camera, project
from bayes_body.model.build import Model
from bayes_body.observation.frames import Frame, read_frame
from bayes_body.posterior import markers, mean_pose
from bayes_body.posterior.frame_text import frame_ranges
from bayes_body.session.session import Keypoints, Session
from bayes_body.tracking.draws import Draws
from bayes_body.view.progress import Watch, unwatched
from bayes_body.view.silhouette import intersection_over_union, projected_masks, seen_in

# The body is not on the person if the median over the cameras of the cover is below the first, or that of the distance (as a fraction of the
# person's size) is above the second.
LEAST_COVER, MOST_DISTANCE = 0.7, 0.2
# Number of consecutive frames that a warning needs: a single bad silhouette gives no warning.
FEWEST_FRAMES = 3
# Keypoints with lower confidence are not used, and neither are cameras with fewer keypoints.
LEAST_CONFIDENCE, FEWEST_POINTS = 0.3, 4
# Distances are cut at this value. A marker behind the camera has no distance and gets this value.
FARTHEST = 10.0


class Fit(NamedTuple):
    """The fit of a frame; NaN for a camera without silhouette or keypoints."""

    overlap: Float[np.ndarray, "run camera"]
    cover: Float[np.ndarray, "run camera"]
    distance: Float[np.ndarray, "run camera"]


def silhouette_overlap(session: Session, draws: Draws, watch: Watch = unwatched) -> Float[np.ndarray, "run frame camera"]:
    """Return the overlap (IoU) of the projected mean body of each run with the silhouettes; NaN where the session has none."""
    frames = watch(range(len(draws.frames)))
    return np.stack([frame_fit(session, draws.model, mean_pose(draws.frames[index], draws.model), index).overlap for index in frames], axis=1)


def frame_fit(session: Session, model: Model, poses: Float[np.ndarray, "run *shape"], index: int) -> Fit:
    """Return the fit of poses (radians and metres) to frame `index`."""
    frame, model = read_frame(session, index), seen_in(model, session, index)
    shape = (len(poses), len(session.views))
    overlap, cover = np.full(shape, np.nan), np.full(shape, np.nan)
    if frame.masks is not None:
        masks = [frame.masks[c] for c in range(len(session.views))]
        for run, pose in enumerate(poses):
            for c, (body, person) in enumerate(zip(projected_masks(model, pose, session), masks, strict=True)):
                if person is not None:
                    overlap[run, c], cover[run, c] = intersection_over_union(body, person), cover_of(body, person)
    return Fit(overlap, cover, _distances(model, poses, frame))


def cover_of(body: Bool[np.ndarray, "row column"], person: Bool[np.ndarray, "row column"]) -> float:
    """Return |body ∩ person| / min(|body|, |person|); 0 if the body is outside of the image, NaN if the person is."""
    areas = np.count_nonzero(body), np.count_nonzero(person)
    if not areas[1]:
        return float("nan")
    return np.count_nonzero(body & person) / min(areas) if areas[0] else 0.0


def _distances(model: Model, poses: Float[np.ndarray, "run *shape"], frame: Frame) -> Float[np.ndarray, "run camera"]:
    """Return the median distance of the markers from the keypoints, as a fraction of the person's size in the image."""
    names = model.body.markers.names
    found = np.full((len(poses), len(frame.seen)), np.nan)
    if frame.keypoints is None or not names:
        return found
    pixels, visible = (np.asarray(out) for out in _projected(model.rig, jnp.asarray(markers(model, poses))))
    for c, keypoints in enumerate(frame.keypoints):
        places = _usable(keypoints, names)
        if len(places) >= FEWEST_POINTS:
            points = np.array(list(places.values()))
            chosen = list(places)
            far = np.linalg.norm(pixels[:, c, chosen] - points, axis=-1) / max(float(np.ptp(points, axis=0).max()), 1.0)
            found[:, c] = np.median(np.where(visible[:, c, chosen], np.minimum(far, FARTHEST), FARTHEST), axis=-1)
    return found


def _usable(keypoints: Keypoints | None, names: Sequence[str]) -> dict[int, tuple[float, float]]:
    """Return the pixels of the usable keypoints, by the index of their marker."""
    found = {name: point for name, point in (keypoints or {}).items() if name in names and point[2] >= LEAST_CONFIDENCE}
    return {names.index(name): (point[0], point[1]) for name, point in found.items()}


@jax.jit
def _projected(rig: Camera, places: Float[Array, "run marker 3"]) -> tuple[Float[Array, "run camera marker 2"], Bool[Array, "run camera marker"]]:
    return jax.vmap(lambda each: jax.vmap(lambda camera: project(camera, each))(rig))(places)


def is_off(fit: Fit) -> Bool[np.ndarray, " run"]:
    """Return whether each run's body is off the person, by the keypoints if there are any, else by the silhouettes; False where neither tells."""
    if np.isfinite(fit.distance).any():
        return np.nan_to_num(_over_cameras(fit.distance), nan=0.0) > MOST_DISTANCE
    return np.nan_to_num(_over_cameras(fit.cover), nan=1.0) < LEAST_COVER


def first_fit(session: Session, model: Model) -> dict[str, Any]:
    """Return the fit of the model's first pose to frame 0, as the keys `fit_by` and `fit_first` of `summary.json`."""
    found = frame_fit(session, model, np.asarray(model.initial[model.body.variable], float)[None], 0)
    return _first(found, np.isfinite(found.distance).any())


def _first(first: Fit, by_keypoints: bool | np.bool_) -> dict[str, Any]:
    values = first.distance if by_keypoints else first.cover
    value = float(_over_cameras(values)[0])
    known = bool(np.isfinite(value))
    return {"fit_by": ("keypoints" if by_keypoints else "silhouettes") if known else None, "fit_first": value if known else None}


def fit_figures(first: Fit, frames: Sequence[Fit]) -> dict[str, Any]:
    """Return the keys of `summary.json` about the fit; by keypoints if there are any, else by silhouettes.

    Args:
        first: fit of the first pose to frame 0.
        frames: fit of each run's mean pose to each frame.
    """
    by_keypoints = any(np.isfinite(each.distance).any() for each in frames)
    values = np.stack([_over_cameras(each.distance if by_keypoints else each.cover) for each in frames])
    worst = np.where(np.isfinite(values), values, -np.inf if by_keypoints else np.inf)
    by_frame = worst.max(axis=1) if by_keypoints else worst.min(axis=1)
    crossed = by_frame > MOST_DISTANCE if by_keypoints else by_frame < LEAST_COVER
    extreme = by_frame.argmax() if by_keypoints else by_frame.argmin()
    known = bool(np.isfinite(by_frame[extreme]))
    figures = {
        "fit_worst": float(by_frame[extreme]) if known else None,
        "fit_worst_frame": int(extreme) if known else None,
        "frames_off": np.flatnonzero(_lasting(crossed)).tolist(),
    }
    return _first(first, by_keypoints) | {"fit_by": ("keypoints" if by_keypoints else "silhouettes") if known else None} | figures


def _over_cameras(values: Float[np.ndarray, "run camera"]) -> Float[np.ndarray, " run"]:
    """Return the median over the cameras that have a value; NaN if none has."""
    return np.array([np.median(row[np.isfinite(row)]) if np.isfinite(row).any() else np.nan for row in values])


def _lasting(crossed: Bool[np.ndarray, " frame"]) -> Bool[np.ndarray, " frame"]:
    """Keep only stretches of at least FEWEST_FRAMES frames, or of all frames if there are fewer."""
    least, out = min(FEWEST_FRAMES, len(crossed)), np.zeros_like(crossed)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], crossed.astype(int), [0]]))).reshape(-1, 2)
    for start, stop in edges:
        out[start:stop] = stop - start >= least
    return out


def fit_sentences(figures: Mapping[str, Any]) -> list[str]:
    """Return warnings about a first pose that does not fit, and about frames in which the body is not on the person.

    Args:
        figures: the figures from `first_fit` or `fit_figures`, or a whole summary. A summary from an older version gives no warnings.
    """
    wording = _WORDINGS.get(figures.get("fit_by") or "")
    return [] if wording is None else [*_first_sentence(wording, figures.get("fit_first")), *_later_sentence(wording, figures)]


class _Wording(NamedTuple):
    is_off: Callable[[float], bool]
    figure: Callable[[float], str]


_WORDINGS = {
    "silhouettes": _Wording(
        lambda value: value < LEAST_COVER,
        lambda value: f"its overlap with the silhouettes, relative to the smaller area, is {value:.2f} (limit {LEAST_COVER:g}; 1 is best)",
    ),
    "keypoints": _Wording(
        lambda value: value > MOST_DISTANCE,
        lambda value: f"its markers are {value:.2f} of the person's size in the image away from the keypoints (limit {MOST_DISTANCE:g}; 0 is best)",
    ),
}


def _first_sentence(wording: _Wording, value: float | None) -> list[str]:
    if value is None or not wording.is_off(value):
        return []
    remedy = "check the calibration, the units and the first pose of the session"
    return [f"frame 0: the body in its first pose does not fit the image: {wording.figure(value)}; {remedy}."]


def _later_sentence(wording: _Wording, figures: Mapping[str, Any]) -> list[str]:
    off, worst = figures.get("frames_off") or [], figures.get("fit_worst")
    if not off or worst is None:
        return []
    to_the_end = off[-1] == figures.get("frames", 0) - 1 and off == list(range(off[0], off[-1] + 1))
    where = f"from frame {off[0]} the body no longer covers the person" if to_the_end else f"{frame_ranges(off)}: the body does not cover the person"
    at_worst = f"at worst, at frame {figures['fit_worst_frame']}, {wording.figure(worst)}"
    again = figures.get("frames_restarted") or []
    restarted = f"; it was restarted at frame{'s' * (len(again) > 1)} {', '.join(map(str, again))}, where the person was found again" if again else ""
    remedy = "the poses there do not follow the person: look at the overlay, and raise --particles or correct the first pose"
    return [f"{where}{restarted}: {at_worst}; {remedy}."]
