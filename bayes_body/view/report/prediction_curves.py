"""Plots and pictures of the posterior predictive check.

The plots are over time, with a panel for each camera. The pictures show one frame of each camera, with what was seen there and what the draws
predict.
"""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import cv2
import numpy as np
from cv2.typing import MatLike
from jaxtyping import Float, Int

from bayes_body.base.errors import escaped
from bayes_body.view.colours import GREY, INK, bgr, over_image, run_line
from bayes_body.view.crop import Crop, crop_about
from bayes_body.view.overlay import backdrop, label
from bayes_body.view.report.figures import encoded, time_label, webp_uri
from bayes_body.view.report.inspection import Inspection
from bayes_body.view.report.markup import Picture
from bayes_body.view.report.panels import frame_panel
from bayes_body.view.report.predicted_silhouettes import body_masks, seen_mask
from bayes_body.view.report.predictive import KeypointCheck, expected_keypoints, keypoint_likelihood, moment, predicted_pixels, seen_keypoints

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from bayes_body.results.storage.saved_run import SavedRun

SIZE = (3.6, 2.3)
LINE = {"marker": "o", "markersize": 3}


def error_panels(inspection: Inspection, frames: Int[np.ndarray, " frame"], check: KeypointCheck) -> Iterator[Picture]:
    """Yield for each camera the errors of the keypoints, over a band of the errors that are predicted."""
    seeker = inspection.diagnosis.mode_seeker
    middle, high = (percentiles(check.error, share) for share in (50, 90))
    top = 1.08 * max(float(np.nanmax(high)), 1.0, 0.0 if seeker else float(np.nanmax(check.expected[..., 1])))
    for c, name in enumerate(cameras(inspection)):
        if not np.isfinite(check.error[:, c]).any():
            continue
        figure, axes = _camera_panel(inspection, f"Camera {escaped(name)}", "reprojection error, px")
        if not seeker:
            _band(axes, frames, np.zeros(len(frames)), check.expected[:, c, 1])
        axes.plot(frames, middle[:, c], color=INK, label="median", **LINE)
        axes.plot(frames, high[:, c], color=INK, linestyle=run_line(2), label="90 % quantile", **LINE)
        axes.set_ylim(0, top)
        yield encoded(figure, f"Reprojection error in camera {name} over time: median {median(check.error[:, c]):.1f} px.")


def silhouette_panels(
    inspection: Inspection,
    frames: Int[np.ndarray, " frame"],
    quantity: str,
    label: str,
    values: Float[np.ndarray, "frame camera draw"],
    expected: Float[np.ndarray, "frame camera end"],
) -> Iterator[Picture]:
    """Yield for each camera a figure of the silhouettes, over a band of what is predicted, if anything is.

    Args:
        inspection: the run.
        frames: the compared frames.
        quantity: `overlap` or `area`.
        label: of the vertical axis.
        values: the figure of each draw.
        expected: the ends of its predictive interval; NaN if there is none.
    """
    # The worst value.
    reach = max(1.1 * float(np.nanmax(np.abs(np.append(values, expected)))), 10.0)
    low, middle, high = (percentiles(values, share) for share in (5, 50, 95))
    for c, name in enumerate(cameras(inspection)):
        if not np.isfinite(values[:, c]).any():
            continue
        figure, axes = _camera_panel(inspection, f"Camera {escaped(name)}: {quantity}", label)
        if np.isfinite(expected[:, c]).any():
            _band(axes, frames, expected[:, c, 0], expected[:, c, 1])
        if not inspection.diagnosis.mode_seeker:
            axes.vlines(frames, low[:, c], high[:, c], color=INK, alpha=0.3, linewidth=5)
        axes.plot(frames, middle[:, c], color=INK, **LINE)
        if quantity == "area":
            axes.axhline(0, color=GREY, linewidth=0.9)
        axes.set_ylim(*((-reach, reach) if quantity == "area" else (0, 1.02)))
        yield encoded(figure, f"Silhouettes of camera {name} over time, {label}: median {median(values[:, c]):.3g}.")


def _band(axes: "Axes", frames: Int[np.ndarray, " frame"], low: Float[np.ndarray, " frame"], high: Float[np.ndarray, " frame"]) -> None:
    if len(frames) > 1:
        axes.fill_between(frames, low, high, color=GREY, alpha=0.25, linewidth=0)
    else:
        axes.vlines(frames, low, high, color=GREY, alpha=0.4, linewidth=9)


def _camera_panel(inspection: Inspection, title: str, label: str) -> "tuple[Figure, Axes]":
    figure, axes = frame_panel(inspection, title, time_label(inspection.fps), label, SIZE)
    if inspection.run.frames > 12:
        # The first and the last compared frame are the recording's: their marks must not be cut.
        axes.set_xlim(-0.02 * inspection.run.frames, 1.02 * (inspection.run.frames - 1))
    return figure, axes


def cameras(inspection: Inspection) -> list[str]:
    """Return the names of the cameras."""
    return [view.camera.name for view in inspection.run.session.views]


def median(values: Float[np.ndarray, "..."]) -> float:
    """Return the median of what is known; NaN if nothing is."""
    return percentile(values, 50)


def percentile(values: Float[np.ndarray, "..."], share: int) -> float:
    """Return the percentile of what is known; NaN if nothing is."""
    finite_values = values[np.isfinite(values)]
    return float(np.percentile(finite_values, share)) if finite_values.size else float("nan")


def percentiles(values: Float[np.ndarray, "*some each"], share: int) -> Float[np.ndarray, "*some"]:
    """Return the percentile over the last axis of what is known; NaN if nothing is."""
    flat = values.reshape(-1, values.shape[-1])
    return np.array([percentile(row, share) for row in flat]).reshape(values.shape[:-1])


WIDEST, QUALITY = 640, 75
BLACK, WHITE = (0, 0, 0), (255, 255, 255)
# The recording is faded by this fraction towards grey, and then towards white, so that the marks stand out.
GREYER, LIGHTER = 0.8, 0.25
# Fixed-point pixels with four fractional bits.
BITS = 4


def keypoint_pictures(run: "SavedRun", index: int) -> Iterator[Picture]:
    """Yield for each camera that sees keypoints in a frame a picture of them and of the predicted ones; the model reads keypoints."""
    inspection = moment(run, index)
    likelihood = keypoint_likelihood(inspection.model)
    assert likelihood is not None
    keypoints, expected = seen_keypoints(inspection, likelihood), expected_keypoints(likelihood, inspection.states)
    detections, names = likelihood.markers.detections, inspection.model.body.markers.names
    marker_names = [names[marker] for marker in likelihood.markers.markers]
    present, middle = keypoints[..., 2] > float(detections.least_confidence), expected[..., :2].mean(axis=0)
    # The first noise of each draw.
    drawn = predicted_pixels(detections, expected, np.where(present, keypoints[..., 2], 1.0), inspection.key)[: len(expected)]
    for c, view in enumerate(run.session.views):
        mask = present[c]
        if not mask.any():
            continue
        image = backdrop(run.session, index, view)[0]
        crop = crop_about(np.concatenate([keypoints[c, mask, :2], middle[c, mask]]), view.camera.size_px, WIDEST)
        picture = _faded(crop.cut(image))
        if not run.mode_seeker:
            picture = _dots(picture, crop.place(drawn[:, c, mask]), [marker_names[place] for place in np.flatnonzero(mask)])
        for pixel, mean in zip(crop.place(keypoints[c, mask, :2]), crop.place(middle[c, mask]), strict=True):
            _residual(picture, pixel, mean)
        alt = f"Seen and predicted keypoints in frame {run.first_frame + index} of camera {view.camera.name}: {mask.sum()} are seen."
        yield _picture(label(picture, f"{view.camera.name}  frame {run.first_frame + index}"), alt)


def silhouette_pictures(run: "SavedRun", index: int) -> Iterator[Picture]:
    """Yield for each camera that sees a silhouette in a frame a picture of its outline over the predicted ones."""
    inspection = moment(run, index)
    for c, (view, bodies) in enumerate(zip(run.session.views, body_masks(inspection.model, run.session, inspection.states), strict=True)):
        silhouette, size = seen_mask(inspection.frame, c), view.camera.size_px
        if silhouette is None:
            continue
        image = backdrop(run.session, index, view)[0]
        share = cv2.resize(np.mean(bodies, axis=0, dtype=np.float32), size, interpolation=cv2.INTER_LINEAR)
        rows, columns = np.nonzero((share > 0) | silhouette)
        crop = crop_about(np.stack([columns, rows], axis=1).astype(float), size, WIDEST)
        picture = _covered(_faded(crop.cut(image)), crop.cut(share))
        lines, _ = cv2.findContours(silhouette.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        outline = [_fixed(crop, line[:, 0].astype(float)) for line in lines]
        for thickness, ink in ((4, WHITE), (2, BLACK)):
            cv2.polylines(picture, outline, True, ink, thickness, cv2.LINE_AA, shift=BITS)
        alt = f"Predicted silhouettes in frame {run.first_frame + index} of camera {view.camera.name}, under the outline of the seen one."
        yield _picture(label(picture, f"{view.camera.name}  frame {run.first_frame + index}"), alt)


def _faded(image: MatLike) -> MatLike:
    grey = cv2.cvtColor(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), cv2.COLOR_GRAY2BGR)
    faded = cv2.addWeighted(grey, GREYER, image, 1 - GREYER, 0)
    return cv2.addWeighted(faded, 1 - LIGHTER, np.full_like(faded, 255), LIGHTER, 0)


def _dots(picture: MatLike, points: Float[np.ndarray, "draw marker 2"], names: Sequence[str]) -> MatLike:
    layer = picture.copy()
    for marker, name in enumerate(names):
        of_marker = points[:, marker]
        for point in _shifted(of_marker[_inside(of_marker, picture)]).tolist():
            cv2.circle(layer, point, 2 << BITS, bgr(over_image(name)), -1, cv2.LINE_AA, shift=BITS)
    return cv2.addWeighted(layer, 0.6, picture, 0.4, 0)


def _residual(picture: MatLike, keypoint: Float[np.ndarray, "2"], mean: Float[np.ndarray, "2"]) -> None:
    """Draw a seen keypoint as a circle, and the line to where it is expected."""
    ends = _shifted(np.stack([keypoint, np.clip(mean, -1e4, 1e4)])).tolist()
    for thickness, ink in ((5, WHITE), (2, BLACK)):
        cv2.line(picture, ends[0], ends[1], ink, thickness, cv2.LINE_AA, shift=BITS)
        cv2.circle(picture, ends[0], 8 << BITS, ink, thickness, cv2.LINE_AA, shift=BITS)


def _covered(picture: MatLike, share: Float[np.ndarray, "row column"]) -> MatLike:
    opacity = 0.6 * np.clip(share, 0, 1)[..., None]
    return np.round(picture * (1 - opacity) + np.array(bgr(over_image(""))) * opacity).astype(np.uint8)


def _inside(points: Float[np.ndarray, "point 2"], picture: MatLike) -> np.ndarray:
    return ((points >= 0) & (points < picture.shape[1::-1])).all(axis=-1)


def _fixed(crop: Crop, points: Float[np.ndarray, "point 2"]) -> np.ndarray:
    return _shifted(crop.place(points))


def _shifted(points: Float[np.ndarray, "point 2"]) -> np.ndarray:
    return np.round(points * (1 << BITS)).astype(np.int32)


def _picture(picture: MatLike, alt: str) -> Picture:
    return Picture(webp_uri(picture, QUALITY), alt, inverts=False)
