"""The first pose, given as angles or fitted to markers or keypoints within the body's limits; and the model that starts from it."""

from bayes_body.initial.first import (
    Show,
    apply_first_pose,
    check_first_pose,
    first_pose,
    fit_first_pose,
    is_fitted,
    load_model,
    with_first_keypoints,
    with_first_pose,
)
from bayes_body.initial.report import FirstPose
from bayes_body.initial.stored import restored, stored

__all__ = [
    "FirstPose",
    "Show",
    "apply_first_pose",
    "check_first_pose",
    "first_pose",
    "fit_first_pose",
    "is_fitted",
    "load_model",
    "restored",
    "stored",
    "with_first_keypoints",
    "with_first_pose",
]
