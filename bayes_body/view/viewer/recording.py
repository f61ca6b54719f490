"""What a run's recording adds to the scene: cameras with their images, true markers, and triangulated keypoints.

A stranger's run may name any file of this machine. A file is shown only if it is the one from which the run was made. A sentence says what is not.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np
from cv2.typing import MatLike
from jaxtyping import Float

from bayes_body.recording.observation.pictures import Colours, read_colour
from bayes_body.recording.readers.camera_path import cameras_at
from bayes_body.recording.readers.keypoints.series import KeypointSeries, read_series
from bayes_body.recording.readers.keypoints.triangulate import triangulate
from bayes_body.recording.session.session import CameraSpec, Session, View
from bayes_body.results.metrics.truth import true_markers

if TYPE_CHECKING:
    from bayes_body.results.storage.saved_run import SavedRun


class Seen(NamedTuple):
    """What the recording has in one frame.

    Attributes:
        cameras: where the cameras are.
        images: the image of each camera in red, green and blue, without distortion (`flat`); None if there is none.
        truth: known true markers in the world, metres.
        keypoints: keypoints on which two or more cameras agree, in the world, metres.
    """

    cameras: Sequence[CameraSpec]
    images: Sequence[Colours | None]
    truth: Float[np.ndarray, "marker 3"]
    keypoints: Float[np.ndarray, "keypoint 3"]


class Recording(NamedTuple):
    """A run's recording as far as it may be shown.

    Attributes:
        session: the session, with those views whose camera can be placed.
        pictured: for each view, whether its images may be shown.
        series: for each view, its keypoints if it has any.
        truth: true markers, (frame, 15, 3), metres; no frames if there are none.
        missing: sentences on what is not shown.
    """

    session: Session
    pictured: Sequence[bool]
    series: Sequence[KeypointSeries | None]
    truth: Float[np.ndarray, "frame 15 3"]
    missing: Sequence[str]

    @property
    def has_keypoints(self) -> bool:
        """Whether two views have keypoints, so that they can be triangulated."""
        return sum(series is not None for series in self.series) > 1

    def frame(self, index: int, width: int | None) -> Seen:
        """Return what is seen in a frame, with images of at most `width` pixels, or without images.

        Raises:
            InputError: an image of the session cannot be used.
        """
        cameras = cameras_at(self.session, index)
        shown = [width if pictured else None for pictured in self.pictured]
        images = [_image(self.session, index, view, wide) for view, wide in zip(self.session.views, shown, strict=True)]
        truth = self.truth[index] if index < len(self.truth) else np.zeros((0, 3))
        return Seen(cameras, images, truth[np.isfinite(truth).all(axis=-1)], self._keypoints(index, cameras))

    def _keypoints(self, index: int, cameras: Sequence[CameraSpec]) -> Float[np.ndarray, "keypoint 3"]:
        detections = [
            (camera, series.frame(self.session.number(view, index)))
            for camera, view, series in zip(cameras, self.session.views, self.series, strict=True)
            if series is not None
        ]
        names = sorted({name for _, points in detections for name in points})
        if len(detections) < 2 or not names:
            return np.zeros((0, 3))
        nowhere = (np.nan, np.nan, 0.0)
        points = triangulate(
            [camera for camera, _ in detections], np.array([[detection.get(name, nowhere) for name in names] for _, detection in detections])
        ).points_m
        return points[np.isfinite(points).all(axis=-1)]


def read_recording(run: "SavedRun") -> Recording:
    """Return the recording of a run, without the files that have changed since the run was made.

    Raises:
        InputError: the session or a file of it cannot be used.
    """
    session, changed, missing = run.session, run.changed_inputs, []
    lost = [view for view in session.views if f"extrinsics of {view.camera.name}" in changed]
    session = replace(session, views=tuple(view for view in session.views if view not in lost))
    pictured = [not changed & {f"images of {view.camera.name}", f"video of {view.camera.name}"} for view in session.views]
    series = [_series(session, view, f"keypoints of {view.camera.name}" in changed) for view in session.views]
    truth = None if "truth" in changed else true_markers(session)
    hidden = {
        "cameras": lost,
        "images": [view for view, shown in zip(session.views, pictured, strict=True) if not shown],
        "keypoints": [view for view in session.views if f"keypoints of {view.camera.name}" in changed],
    }
    for kind, views in hidden.items():
        if views:
            names = ", ".join(view.camera.name for view in views)
            missing.append(f"The {kind} of {names} are not shown: their files are not those from which the run was made.")
    if "truth" in changed:
        missing.append("The true markers are not shown: their file is not the one from which the run was made.")
    return Recording(session, pictured, series, np.zeros((0, 15, 3)) if truth is None else truth, missing)


def _series(session: Session, view: View, changed: bool) -> KeypointSeries | None:
    path = session.keypoints_path(view)
    return None if path is None or changed else read_series(path)


def _image(session: Session, index: int, view: View, width: int | None) -> Colours | None:
    image = None if width is None else read_colour(session, index, view)
    return None if image is None or width is None else np.asarray(cv2.cvtColor(flat(image, view.camera, width), cv2.COLOR_BGR2RGB), np.uint8)


def flat(image: MatLike, camera: CameraSpec, width: int) -> MatLike:
    """Return the image that the camera would take without distortion and with its axis through the middle; `width`: its longer side, pixels."""
    scale = min(1.0, width / max(camera.size_px))
    size = max(round(camera.size_px[0] * scale), 1), max(round(camera.size_px[1] * scale), 1)
    # Both maps hold for the centres of pixels, which are at whole coordinates.
    fx, fy = (focal * scale for focal in camera.focal_px)
    cx, cy = ((centre + 0.5) * scale - 0.5 for centre in camera.centre_px)
    camera_matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    middle = np.array([[fx, 0, (size[0] - 1) / 2], [0, fy, (size[1] - 1) / 2], [0, 0, 1.0]])
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return cv2.undistort(small, camera_matrix, np.array(camera.distortion), None, middle)
