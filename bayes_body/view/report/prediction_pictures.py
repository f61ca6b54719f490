"""Pictures of the posterior predictive check: one frame of each camera, with what was seen there and what the draws predict."""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import cv2
import numpy as np
from cv2.typing import MatLike
from jaxtyping import Float

from bayes_body.view.colours import bgr, over_image
from bayes_body.view.crop import Crop, crop_about
from bayes_body.view.overlay import backdrop, label
from bayes_body.view.report.figures import data_uri
from bayes_body.view.report.markup import Picture
from bayes_body.view.report.predicted_keypoints import expected_pixels, marker_likelihood, predicted_pixels
from bayes_body.view.report.predicted_silhouettes import body_masks, seen_mask
from bayes_body.view.report.predictive import moment, seen_keypoints

if TYPE_CHECKING:
    from bayes_body.results.storage.saved_run import SavedRun

WIDEST, QUALITY = 640, 75
BLACK, WHITE = (0, 0, 0), (255, 255, 255)
# The recording is faded by this fraction towards grey, and then towards white, so that the marks stand out.
GREYER, LIGHTER = 0.8, 0.25
# Fixed-point pixels with four fractional bits.
BITS = 4


def keypoint_pictures(run: "SavedRun", index: int) -> Iterator[Picture]:
    """Yield for each camera that sees keypoints in a frame a picture of them and of the predicted ones; the model reads keypoints."""
    it, run_likelihood = moment(run, index), marker_likelihood(run.model)
    assert run_likelihood is not None
    keypoints, points = seen_keypoints(it)
    likelihood = marker_likelihood(it.model)
    assert likelihood is not None
    detections, marker_names = likelihood[1].detections, [it.model.body.markers.names[place] for place in likelihood[1].markers]
    present = keypoints[..., 2] > float(detections.least_confidence)
    middle = expected_pixels(detections, points).mean(axis=0)
    # The first noise of each draw.
    drawn = predicted_pixels(detections, points, np.where(present, keypoints[..., 2], 1.0), it.key)[: len(points)]
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
    it = moment(run, index)
    for c, (view, bodies) in enumerate(zip(run.session.views, body_masks(it.model, run.session, it.poses), strict=True)):
        silhouette, size = seen_mask(it.frame, c), view.camera.size_px
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
    content = cv2.imencode(".webp", picture, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])[1].tobytes()
    return Picture(data_uri("image/webp", content), alt, inverts=False)
