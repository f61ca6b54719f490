r"""The description of a recording: calibrated cameras, their images, the subject's measurements and the first pose.

Plain data in metres, radians and pixels. `bayes_body.recording.session.read` reads and writes it.
"""

from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class CameraSpec:
    """One calibrated camera in Bouguet's (OpenCV's) model.

    Attributes:
        name: its name within the session.
        size_px: (width, height) of its images.
        focal_px: focal lengths (x, y).
        centre_px: the principal point (column, row); the first pixel's centre is (0, 0).
        skew: alpha_c, 0 for nearly every camera.
        distortion: (k1, k2, p1, p2, k3).
        rotation: (3, 3), `X_camera = rotation @ X_world + translation_m`.
        translation_m: (3,), metres.
    """

    name: str
    size_px: tuple[int, int]
    focal_px: tuple[float, float]
    centre_px: tuple[float, float]
    skew: float
    distortion: tuple[float, float, float, float, float]
    rotation: NDArray[np.float64]
    translation_m: NDArray[np.float64]

    def __eq__(self, value: object) -> bool:
        """Compare all numbers. (The comparison that dataclass generates fails on arrays.)"""
        if not isinstance(value, CameraSpec):
            return NotImplemented
        return all(np.array_equal(getattr(self, f.name), getattr(value, f.name)) for f in fields(self))


@dataclass(frozen=True)
class CameraUncertainty:
    """How well a camera is known, where the session says so: standard deviations. None: what a model assumes.

    Attributes:
        turn_sd: of turns about the camera's axes x, y and z, radians.
        move_sd_m: of moves along these axes, metres.
        focal_sd: of the focal length, relative.
        centre_sd_px: of the principal point (column, row), pixels.
        delay_s: how late the camera is against the first one, beside its `offset`, seconds.
        delay_sd_s: of the delay, seconds.
    """

    turn_sd: tuple[float, float, float] | None = None
    move_sd_m: tuple[float, float, float] | None = None
    focal_sd: float | None = None
    centre_sd_px: tuple[float, float] | None = None
    delay_s: float = 0.0
    delay_sd_s: float | None = None


class Span(NamedTuple):
    """Successive frames of a video at successive instants of its camera's clock.

    Attributes:
        instant: the first instant.
        frame: the number of its frame in the video.
        frames: their number.
    """

    instant: int
    frame: int
    frames: int


@dataclass(frozen=True)
class View:
    """What one camera recorded: either image files or a video. Relative paths start at the session's folder.

    Attributes:
        camera: its calibration.
        images: printf pattern of its image files, such as `CAM1/image%04d.bmp`.
        video: path of its video.
        masks: printf pattern of its silhouettes; None: they are computed from the background.
        background: path of an image or a video of the empty scene; None: the background is learned from the recording.
        offset: the session's frame k is this camera's frame k + offset; with `spans`, its instant k + offset.
        keypoints: path of an .npz with the subject's keypoints in each frame; None if there are none.
        path: path of an .npz with a moving camera's extrinsics in each frame (`camera` holds those of frame 0); None if the camera stands still.
        video_fps: the rate that the video's container states, if it is not the session's: a slow-motion video is played at another rate than filmed.
        uncertainty: how well the calibration and the clock are known.
        spans: where the video's frames are on the camera's clock, ascending: (first instant, first frame, number of frames) of each run of them. At
            other instants the camera has no frame. (): frame k is at instant k.
    """

    camera: CameraSpec
    images: str | None = None
    masks: str | None = None
    video: str | None = None
    background: str | None = None
    offset: int = 0
    keypoints: str | None = None
    path: str | None = None
    video_fps: float | None = None
    uncertainty: CameraUncertainty = CameraUncertainty()
    spans: tuple[Span, ...] = ()


@dataclass(frozen=True)
class Segmentation:
    """How silhouettes are found in a session without masks, and whose they are.

    Attributes:
        threshold: squared Mahalanobis distance from the background at which a pixel is equally likely foreground and background.
        learning_frames: number of evenly spaced frames from which the background is learned.
        shadows: whether darker pixels with the background's colour count as background.
        follow_exposure: whether the image's brightness is first matched to the background's.
        figures: which figures of a silhouette can be the subject's, masks included. With "near_body", large ones away from
            where the body was in the frame before count as not seen.
    """

    threshold: float = 16.0
    learning_frames: int = 200
    shadows: bool = True
    follow_exposure: bool = True
    figures: Literal["all", "near_body"] = "all"


# For one camera: keypoint name -> (column, row, confidence); pixels, confidence between 0 and 1.
type Keypoints = Mapping[str, tuple[float, float, float]]


@dataclass(frozen=True)
class Subject:
    """The person: known measurements, by the body's names. The body's proportions supply what is missing.

    Attributes:
        body: the body whose names and dofs are used; None: the model decides.
        height_m: stature.
        lengths_m: segment lengths.
        radii_m: (base, tip) of a part.
        sections: (x, y) scale factors of a part's section.
        motion_sd: standard deviation of the change between successive frames, by dof; radians or metres.
        outline_radii_m: (base, tip) of a part as seen in the images, clothes included. Missing parts use `radii_m`.
        lengths_sd: relative standard deviation of a length; `overall` is the share that all lengths have in common.
        keypoint_offsets_m: x, y, z of a keypoint beside its marker, in the frame of the marker's joint.
        keypoint_offsets_sd_m: standard deviations of these; 0 along an axis of which nothing is said.
    """

    body: str | None = None
    height_m: float | None = None
    lengths_m: Mapping[str, float] = field(default_factory=dict)
    radii_m: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    sections: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    motion_sd: Mapping[str, float] = field(default_factory=dict)
    outline_radii_m: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    lengths_sd: Mapping[str, float] = field(default_factory=dict)
    keypoint_offsets_m: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    keypoint_offsets_sd_m: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)


@dataclass(frozen=True)
class Session:
    """A recording, or a range of its frames. Frames are counted from 0; frame k has the number `first_frame + k` in file names and for the user.

    Attributes:
        folder: the folder of `session.toml`; relative paths start here.
        title: one line for the reader.
        up: the world's axis that points up.
        fps: frames per second.
        frames: number of frames.
        first_frame: number of the first frame in file names.
        views: one for each camera.
        subject: the person.
        initial: the known part of the pose of frame 0, by dof; radians or metres.
        initial_markers: world positions of virtual markers in frame 0, metres, by name.
        initial_keypoints: keypoints in frame 0, by camera.
        fit_lengths: whether the body's lengths are fitted together with the first pose.
        fit_outline: whether the body's apparent thickness is fitted to the first frame's silhouettes.
        segmentation: how silhouettes are found if there are no masks.
        truth: path of an .npz file with true markers, relative to the session's folder.
        positions: names of the dofs in `initial` and `subject.motion_sd` that are positions (metres); all others are angles.
        recorded: number of the first frame of the whole recording, and its number of frames; None if the session has them all.
        calibration: path of the file or folder from which the cameras were imported, relative to the session's folder; None if there is none.
    """

    folder: Path
    title: str
    up: Literal["x", "y", "z"]
    fps: float
    frames: int
    first_frame: int
    views: tuple[View, ...]
    subject: Subject = Subject()
    initial: Mapping[str, float] = field(default_factory=dict)
    positions: frozenset[str] = frozenset()
    initial_markers: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    initial_keypoints: Mapping[str, Keypoints] = field(default_factory=dict)
    fit_lengths: bool = False
    fit_outline: bool = False
    segmentation: Segmentation = Segmentation()
    truth: str | None = None
    recorded: tuple[int, int] | None = None
    calibration: str | None = None

    @property
    def skipped(self) -> int:
        """Number of recorded frames before the first one. Files that have a row for each recorded frame are read from that row."""
        return 0 if self.recorded is None else self.first_frame - self.recorded[0]

    @property
    def recorded_session(self) -> "Session":
        """The session of all recorded frames. A first pose that it has is that of another frame."""
        if self.recorded is None:
            return self
        first, frames = self.recorded
        return replace(self, first_frame=first, frames=frames, recorded=None)

    def frame_number(self, frame: int) -> int:
        """The number by which the user knows a frame (counted from 0). A camera's own numbers have its offset added (`number`)."""
        return self.first_frame + frame

    def number(self, view: View, frame: int) -> int:
        """The number of a frame (counted from 0) in this camera's image names, or the instant on its video's clock."""
        return self.first_frame + frame + view.offset

    def file_number(self, view: View, frame: int) -> int | None:
        """The number of a frame (counted from 0) in this camera's image names, or in its video; None if the video has none at its instant."""
        instant = self.number(view, frame)
        if not view.spans:
            return instant
        span = view.spans[max(bisect_right(view.spans, instant, key=lambda run: run.instant) - 1, 0)]
        row = instant - span.instant
        return span.frame + row if 0 <= row < span.frames else None

    def image_path(self, view: View, frame: int) -> Path | None:
        """The image file of a frame; None if the camera has a video."""
        return None if view.images is None else self.folder / (view.images % self.number(view, frame))

    def mask_path(self, view: View, frame: int) -> Path | None:
        """The silhouette file of a frame; None if the session has no masks, or the camera no frame."""
        number = self.file_number(view, frame)
        return None if view.masks is None or number is None else self.folder / (view.masks % number)

    def video_path(self, view: View) -> Path | None:
        """The camera's video; None if it has image files."""
        return None if view.video is None else self.folder / view.video

    def background_path(self, view: View) -> Path | None:
        """The image or video of the empty scene; None if there is none."""
        return None if view.background is None else self.folder / view.background

    def keypoints_path(self, view: View) -> Path | None:
        """The file of the subject's keypoints; None if there is none."""
        return None if view.keypoints is None else self.folder / view.keypoints

    def camera_path(self, view: View) -> Path | None:
        """The file of a moving camera's extrinsics; None if the camera stands still."""
        return None if view.path is None else self.folder / view.path

    @property
    def moves(self) -> bool:
        """Whether any camera moves."""
        return any(view.path is not None for view in self.views)

    @property
    def calibration_path(self) -> Path | None:
        """The file or folder from which the cameras were imported; None if it is not known."""
        return None if self.calibration is None else self.folder / self.calibration

    @property
    def truth_path(self) -> Path | None:
        """The file of true markers; None if they are unknown."""
        return None if self.truth is None else self.folder / self.truth
