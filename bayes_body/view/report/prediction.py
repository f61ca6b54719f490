"""The section on the posterior predictive check: keypoints and silhouettes that the draws predict, against the seen ones, camera by camera."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Int

from bayes_body.view.report.inspection import Inspection
from bayes_body.view.report.markup import Markup, figures, section, table, tag
from bayes_body.view.report.predicted_silhouettes import SilhouetteCheck, silhouette_likelihood
from bayes_body.view.report.prediction_curves import (
    cameras,
    error_panels,
    keypoint_pictures,
    median,
    percentile,
    percentiles,
    silhouette_panels,
    silhouette_pictures,
)
from bayes_body.view.report.predictive import KeypointCheck, keypoint_likelihood, noise_in_words

TITLE = "Posterior predictive check"
ABOUT = (
    "Would the posterior produce the images that were seen? At {frames}, {draws} of all runs together, with equal weight, predict what each camera "
    "sees. The draws were made from the same images. So the check finds a model that does not fit them, and does not measure predictions of new ones."
)
SEEKER = "At {frames}, the mean pose predicts what each camera sees. The kernel is a mode seeker, so there are no intervals."
ERROR = "The error of a keypoint is its distance from the mean of the pixels at which the draws expect it, in pixels of the recording."
KEYPOINTS = (
    f"{ERROR} A predicted keypoint is the marker of a drawn pose plus noise drawn from the likelihood: {{noise}}. The grey band holds 90 % of the "
    "errors of predicted keypoints."
)
SHARE = (
    "If the model is right, 90 % of the seen coordinates (columns and rows) are inside their 90 % predictive intervals. Far fewer mean that a camera "
    "is badly calibrated, that keypoints are wrong, or that the noise of the likelihood is too small. Nearly all mean that the noise is too large."
)
MARKS = "Black circles with a white edge are the seen keypoints, with a line to where the posterior mean expects them."
CLOUD = "Dots are predicted keypoints, one for each draw of the pose: left blue, right orange, middle green."
SILHOUETTES = (
    "Overlap is the intersection of the drawn body's silhouette and the seen one, divided by their union (IoU); 1 is best. The difference of the "
    "areas is positive if the body is larger than the seen silhouette. "
)
SPREAD = (
    "The line is the median of the draws, and the bars are their 90 % interval. The mean pose, whose overlap is at the head of the page, overlaps "
    "more than a draw. "
)
DRAWN = (
    "A predicted silhouette is one that is drawn from the likelihood around a drawn body, pixel by pixel. The grey band is the 90 % interval of the "
    "same figures for predicted silhouettes. If the model is right, the line is in the band in 90 % of the frames."
)
BARE = (
    "The intervals are those of the body alone: the likelihood of silhouettes is not a distribution over images, so it has no noise that can be "
    "drawn. Real silhouettes contain hands, feet and clothes that the body lacks, so even the true pose does not reach an overlap of 1."
)
COVER = "Green is the share of the draws whose body covers a pixel (strongest: all). The black line is the outline of the seen silhouette."


def prediction_section(inspection: Inspection) -> Markup:
    """Return the section: a table by camera, curves over time and a picture of each camera; a sentence if nothing can be compared."""
    prediction = inspection.prediction
    if isinstance(prediction, str):
        return section("prediction", TITLE, tag("p", prediction))
    seeker = inspection.diagnosis.mode_seeker
    frames = "the only frame" if inspection.run.frames == 1 else f"{len(prediction.frames)} evenly spaced frames"
    parts = [tag("p", (SEEKER if seeker else ABOUT).format(frames=frames, draws=f"{prediction.draws} draws of the pose"))]
    if prediction.keypoints is not None:
        parts += _keypoint_parts(inspection, prediction.frames, prediction.keypoints)
    if prediction.silhouettes is not None:
        parts += _silhouette_parts(inspection, prediction.frames, prediction.silhouettes)
    return section("prediction", TITLE, *parts)


def _keypoint_parts(inspection: Inspection, frames: Int[np.ndarray, " frame"], check: KeypointCheck) -> Iterator[Markup]:
    likelihood, seeker = keypoint_likelihood(inspection.run.model), inspection.diagnosis.mode_seeker
    assert likelihood is not None
    yield tag("h3", "Keypoints")
    if not np.isfinite(check.error).any():
        yield tag("p", "No camera sees a keypoint in the compared frames.")
        return
    yield tag("p", ERROR if seeker else f"{KEYPOINTS.format(noise=noise_in_words(likelihood.markers.detections))} {SHARE}")
    yield _keypoint_table(cameras(inspection), check, seeker)
    yield figures(error_panels(inspection, frames, check))
    worst = _worst(frames, np.array([median(errors) for errors in check.error]))
    yield tag("p", f"Of the compared frames, frame {inspection.number(worst)} has the largest errors. {MARKS}{'' if seeker else f' {CLOUD}'}")
    yield figures(keypoint_pictures(inspection.run, worst))


def _keypoint_table(names: list[str], check: KeypointCheck, seeker: bool) -> Markup:
    """Return a row for each camera and one for all of them."""
    head = ["camera", "seen keypoints", "error, median, px", "error, 90 % quantile, px"]
    head += [] if seeker else ["predicted, median, px", "predicted, 90 % quantile, px", "coordinates inside 90 %"]
    rows = []
    for name, chosen in [*((name, [c]) for c, name in enumerate(names)), *([("all cameras", [*range(len(names))])] if len(names) > 1 else [])]:
        errors, expected, inside = (values[:, chosen] for values in check)
        cells = [f"{np.isfinite(errors).sum():,}", _px(percentile(errors, 50)), _px(percentile(errors, 90))]
        cells += [] if seeker else [_px(median(expected[..., k])) for k in (0, 1)] + [_percent(inside)]
        rows.append([name, *cells])
    return table(head, rows)


def _silhouette_parts(inspection: Inspection, frames: Int[np.ndarray, " frame"], check: SilhouetteCheck) -> Iterator[Markup]:
    yield tag("h3", "Silhouettes")
    if not np.isfinite(check.overlap).any():
        yield tag("p", "No camera sees a silhouette in the compared frames.")
        return
    spread = "" if inspection.diagnosis.mode_seeker else SPREAD + (BARE if silhouette_likelihood(inspection.run.model) is None else DRAWN)
    yield tag("p", f"{SILHOUETTES}{spread}")
    yield _silhouette_table(cameras(inspection), check)
    yield figures(silhouette_panels(inspection, frames, "overlap", "overlap (IoU)", check.overlap, check.expected_overlap))
    yield figures(silhouette_panels(inspection, frames, "area", "difference, % of the seen", 100 * check.area, 100 * check.expected_area))
    worst = _worst(frames, -np.array([median(overlaps) for overlaps in check.overlap]))
    yield tag("p", f"Of the compared frames, frame {inspection.number(worst)} has the smallest overlap. {COVER}")
    yield figures(silhouette_pictures(inspection.run, worst))


def _silhouette_table(names: list[str], check: SilhouetteCheck) -> Markup:
    expects = bool(np.isfinite(check.expected_overlap).any())
    rows = []
    for c, name in enumerate(names):
        overlap, area = check.overlap[:, c], check.area[:, c]
        cells = [f"{np.isfinite(overlap).any(axis=-1).sum():,}", _figure(median(overlap)), _figure(percentile(overlap, 5)), _signed(median(area))]
        if expects:
            low, high = check.expected_overlap[:, c].T
            middle = percentiles(overlap, 50)
            is_finite = np.isfinite(middle) & np.isfinite(low)
            cells += [_figure(median((low + high) / 2)), _percent(np.where(is_finite, (low <= middle) & (middle <= high), np.nan))]
        rows.append([name, *cells])
    head = ["camera", "frames", "overlap, median", "overlap, 5 % quantile", "difference of the areas, median"]
    return table([*head, *(["predicted overlap", "frames inside its 90 %"] if expects else [])], rows)


def _worst(frames: Int[np.ndarray, " frame"], badness: Float[np.ndarray, " frame"]) -> int:
    return int(frames[np.nanargmax(badness)])


def _px(value: float) -> str:
    return "–" if np.isnan(value) else f"{value:.1f}"


def _figure(value: float) -> str:
    return "–" if np.isnan(value) else f"{value:.2f}"


def _signed(value: float) -> str:
    # A true minus, and no sign before a zero.
    return "–" if np.isnan(value) else f"{100 * value:+.0f} %".replace("-", "−").replace("−0 ", "0 ").replace("+0 ", "0 ")


def _percent(shares: Float[np.ndarray, "..."]) -> str:
    return f"{100 * np.nanmean(shares):.0f} %" if np.isfinite(shares).any() else "–"
