"""A picture of a fit: of each camera one frame, before and after, with its keypoints and where the model expects them.

A keypoint is a yellow ring. A dot in the colour of its side is where the model expects it, and a line joins the two.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from cv2.typing import MatLike
from jaxtyping import Float

from bayes_body.recording.session.session import Session
from bayes_body.view.colours import KEYPOINTS, bgr, over_image
from bayes_body.view.crop import Crop, crop_about
from bayes_body.view.overlay import backdrop, label, write_png
from bayes_body.view.rig_check import padded
from bayes_body.view.windows import STILL_HEIGHT, grid

WHITE = (255, 255, 255)
# Pixels of the picture; fractions of a pixel that OpenCV's coordinates count.
RING_PX, DOT_PX, LINE_PX = 13, 6, 3
# Share of the image's brightness that is left under the marks.
DIMMED = 0.6
LEGEND = "ring: keypoint, dot: where the body puts it"
FRACTION_BITS = 4


class Expected(NamedTuple):
    """Where a session's model expects the keypoints of a frame.

    Attributes:
        title: what the picture calls the session, such as `before`.
        pixels: column and row of each marker in each camera; NaN behind a camera.
        median_px: median distance from the keypoints over all frames, in each camera, pixels.
    """

    title: str
    pixels: Float[np.ndarray, "camera marker 2"]
    median_px: Sequence[float]


def draw_fit(
    path: Path, session: Session, index: int, names: Sequence[str], keypoints: Float[np.ndarray, "camera marker 2"], states: Sequence[Expected]
) -> None:
    """Write the picture.

    Args:
        path: of the picture.
        session: the recording.
        index: its frame.
        names: of the markers.
        keypoints: column and row in each camera; NaN where not found.
        states: the sessions that are compared.

    Raises:
        InputError: an image cannot be read, or the picture cannot be written.
    """
    tiles = []
    for camera, view in enumerate(session.views):
        image, note = backdrop(session, index, view)
        shown = np.concatenate([keypoints[camera], *(state.pixels[camera] for state in states)])
        crop = crop_about(shown[np.isfinite(shown).all(axis=1)], (image.shape[1], image.shape[0]), STILL_HEIGHT, most_zoom=np.inf)
        pair = []
        for state in states:
            picture = _with_keypoints(crop, image, names, keypoints[camera], state.pixels[camera])
            text = f"{view.camera.name}, frame {session.frame_number(index)}, {state.title}\nmedian {state.median_px[camera]:.1f} px{note}\n{LEGEND}"
            pair.append(padded(label(picture, text)))
        tiles.append(np.hstack(pair))
    write_png(path, grid(tiles))


def _with_keypoints(
    crop: Crop, image: MatLike, names: Sequence[str], keypoints: Float[np.ndarray, "marker 2"], expected: Float[np.ndarray, "marker 2"]
) -> MatLike:
    picture = cv2.convertScaleAbs(crop.cut(image), alpha=DIMMED)
    rings, dots = (_fixed(crop.place(points)) for points in (keypoints, expected))
    for name, keypoint, place in zip(names, rings, dots, strict=True):
        if keypoint is None or place is None:
            continue
        cv2.line(picture, keypoint, place, WHITE, LINE_PX, cv2.LINE_AA, FRACTION_BITS)
        cv2.circle(picture, keypoint, RING_PX << FRACTION_BITS, bgr(KEYPOINTS), LINE_PX, cv2.LINE_AA, FRACTION_BITS)
        cv2.circle(picture, place, DOT_PX << FRACTION_BITS, bgr(over_image(name)), cv2.FILLED, cv2.LINE_AA, FRACTION_BITS)
    return picture


def _fixed(points: Float[np.ndarray, "point 2"]) -> list[tuple[int, int] | None]:
    """Return points in OpenCV's numbers, which count fractions of a pixel; None for a point that is not known."""
    rounded = np.round(np.nan_to_num(points) * 2**FRACTION_BITS).astype(int).tolist()
    return [(column, row) if is_finite else None for (column, row), is_finite in zip(rounded, np.isfinite(points).all(axis=-1), strict=True)]
