"""What a pose estimator does while a session is recorded: it writes keypoints of a person in OpenPose's format, one file per frame and camera."""

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np

from bayes_body.recording.readers.keypoints.imported import with_keypoints
from bayes_body.recording.readers.keypoints.openpose import LAYOUTS
from bayes_body.recording.readers.options import Options
from bayes_body.recording.session.session import Session, View

KEYPOINTS = len(LAYOUTS["COCO_17"])


class PoseEstimator:
    """Writes the keypoints of a moving person, as the cameras of a session see them, to a folder CAMERA_json of each camera."""

    def __init__(self, session: Session, folder: Path):
        self.session, self.folder = session, folder
        for view in session.views:
            self.folder_of(view).mkdir(parents=True)

    def folder_of(self, view: View) -> Path:
        return self.folder / f"{view.camera.name}_json"

    def path(self, view: View, frame: int) -> Path:
        return self.folder_of(view) / f"{view.camera.name}.{self.session.number(view, frame):04d}.json"

    def text(self, view: View, frame: int) -> str:
        camera = view.camera
        points = np.random.default_rng(0).uniform([-0.4, -0.4, 0.8], [0.4, 0.4, 1.6], (KEYPOINTS, 3))
        points[:, 2] += 0.01 * frame
        (fx, fy), (cx, cy) = camera.focal_px, camera.centre_px
        matrix = np.array([[fx, camera.skew, cx], [0, fy, cy], [0, 0, 1]])
        rotation, distortion = cv2.Rodrigues(np.asarray(camera.rotation))[0], np.array(camera.distortion)
        pixels = cv2.projectPoints(points, rotation, np.asarray(camera.translation_m), matrix, distortion)[0][:, 0]
        rows = np.column_stack([pixels, np.full(KEYPOINTS, 0.8)])
        return json.dumps({"people": [{"pose_keypoints_2d": rows.ravel().tolist()}]})

    def write(self, frames: range) -> None:
        """Write frame after frame; of each file first one half."""
        for frame in frames:
            for view in self.session.views:
                text = self.text(view, frame)
                with self.path(view, frame).open("w", encoding="utf-8") as file:
                    file.write(text[: len(text) // 2])
                    file.flush()
                    file.write(text[len(text) // 2 :])

    def imported(self, folder: Path, frames: int) -> Session:
        """The session with so many frames, imported to a folder."""
        session = dataclasses.replace(self.session, folder=folder, frames=frames)
        return with_keypoints(session, {view.camera.name: self.folder_of(view) for view in session.views}, Options(layout="COCO_17"))[0]
