"""What a recording is: calibrated cameras, their images frame by frame, the subject's measures and the first pose.

Plain data: metres, radians, pixels; session_file.py reads and writes it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class CameraSpec:
    """One calibrated camera, Bouguet's (OpenCV's) model.

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

    def __eq__(self, other: object) -> bool:
        """Whether every number is the same (dataclass's own comparison fails on arrays)."""
        if not isinstance(other, CameraSpec):
            return NotImplemented
        return all(np.array_equal(getattr(self, f.name), getattr(other, f.name)) for f in fields(self))


@dataclass(frozen=True)
class View:
    """What one camera recorded, as image files or as a video (exactly one of the two). Relative paths start at the session's folder.

    Attributes:
        camera: its calibration.
        images: printf pattern of its image files, such as `CAM1/image%04d.bmp`.
        video: path of its video.
        masks: printf pattern of its silhouettes; None where they are to be computed from the background.
        background: path of an image or a video of the empty scene; None where the background is to be learned from the recording.
        offset: frames by which this camera's numbering is ahead: the session's frame k is its own k + offset.
        keypoints: path of an .npz with the subject's keypoints in each frame; None where there are none.
        path: path of an .npz with where a moving camera is in each frame; its calibration is that of frame 0. None of one that stands still.
    """

    camera: CameraSpec
    images: str | None = None
    masks: str | None = None
    video: str | None = None
    background: str | None = None
    offset: int = 0
    keypoints: str | None = None
    path: str | None = None


@dataclass(frozen=True)
class Segmentation:
    """How silhouettes are told from the background, where a session brings no masks.

    Attributes:
        threshold: squared Mahalanobis distance from the background at which a pixel is as likely foreground as background.
        learning_frames: frames, evenly spaced, from which the background is learned.
        shadows: whether darker pixels of the background's own colour count as background.
        follow_exposure: whether the image's brightness is first brought to the background's.
    """

    threshold: float = 16.0
    learning_frames: int = 200
    shadows: bool = True
    follow_exposure: bool = True


# Of one camera: a keypoint's name -> column, row (pixels) and confidence, between 0 and 1.
type Keypoints = Mapping[str, tuple[float, float, float]]


@dataclass(frozen=True)
class Subject:
    """The person: measures that are known, by the names of the body; what is missing follows from the body's proportions.

    Attributes:
        body: the body that names and dofs belong to; None leaves it to the model.
        height_m: stature.
        lengths_m: segment lengths.
        radii_m: (base, tip) of a part.
        sections: (x, y) scale factors of a part's section.
        motion_sd: standard deviation of the change from one frame to the next, by dof, radians or metres.
        outline_radii_m: (base, tip) of a part as it looks, clothes included; what is missing looks as thick as it is.
    """

    body: str | None = None
    height_m: float | None = None
    lengths_m: Mapping[str, float] = field(default_factory=dict)
    radii_m: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    sections: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    motion_sd: Mapping[str, float] = field(default_factory=dict)
    outline_radii_m: Mapping[str, tuple[float, float]] = field(default_factory=dict)


@dataclass(frozen=True)
class Session:
    """A recording. Frames are counted from 0; frame k is in the files numbered `first_frame + k`.

    Attributes:
        folder: where `session.toml` lies; relative image patterns start here.
        title: one line for people.
        up: the world's axis that points up.
        fps: frames a second.
        frames: how many there are.
        first_frame: number of the first frame in file names.
        views: one for each camera.
        subject: the person.
        initial: the pose of frame 0 as far as it is known, by dof, radians or metres.
        initial_markers: world positions of virtual markers in frame 0, metres, by name.
        initial_keypoints: where keypoints are in frame 0, by camera.
        fit_lengths: whether the body's lengths are fitted with the first pose.
        fit_outline: whether it is fitted to the first frame's silhouettes how thick the body looks.
        segmentation: how silhouettes are found without masks.
        truth: path of an .npz file with true markers, from the session's folder on.
        positions: names of those dofs in `initial` and `subject.motion_sd` that are positions (metres); all others are angles.
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

    def number(self, view: View, frame: int) -> int:
        """The number of a frame (counted from 0) in a camera's own files: in its images' names, or from a video's beginning."""
        return self.first_frame + frame + view.offset

    def image_path(self, view: View, frame: int) -> Path | None:
        """The file of a frame's image, or None where the camera has a video."""
        return None if view.images is None else self.folder / (view.images % self.number(view, frame))

    def mask_path(self, view: View, frame: int) -> Path | None:
        """The file of a frame's silhouette, or None where the session has none."""
        return None if view.masks is None else self.folder / (view.masks % self.number(view, frame))

    def video_path(self, view: View) -> Path | None:
        """The camera's video, or None where it has image files."""
        return None if view.video is None else self.folder / view.video

    def background_path(self, view: View) -> Path | None:
        """The image or video of the empty scene, or None where there is none."""
        return None if view.background is None else self.folder / view.background

    def keypoints_path(self, view: View) -> Path | None:
        """The file of the subject's keypoints, or None where there is none."""
        return None if view.keypoints is None else self.folder / view.keypoints

    def camera_path(self, view: View) -> Path | None:
        """The file of a moving camera's places, or None where it stands still."""
        return None if view.path is None else self.folder / view.path

    @property
    def moves(self) -> bool:
        """Whether any camera does."""
        return any(view.path is not None for view in self.views)

    @property
    def truth_path(self) -> Path | None:
        """The file of true markers, or None where they are unknown."""
        return None if self.truth is None else self.folder / self.truth
