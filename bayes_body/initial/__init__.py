"""The first pose: given as angles, fitted to markers or keypoints, searched in the pictures, or stored; and the model that starts from it."""

from bayes_body.initial.first import (
    Show,
    apply_first_pose,
    first_pose,
    first_pose_source,
    load_model,
    unposed,
    with_first_keypoints,
)
from bayes_body.initial.fitting.report import FirstPose
from bayes_body.initial.stored import restored, stored

__all__ = [
    "FirstPose",
    "Show",
    "apply_first_pose",
    "first_pose",
    "first_pose_source",
    "load_model",
    "restored",
    "stored",
    "unposed",
    "with_first_keypoints",
]
