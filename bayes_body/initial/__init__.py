"""The first pose: given as angles, fitted to markers or keypoints, or found in the pictures; and the model that starts from it."""

from bayes_body.initial.first import (
    Show,
    apply_first_pose,
    check_first_pose,
    first_pose,
    fit_first_pose,
    is_fitted,
    is_posed,
    load_model,
    unposed,
    with_first_keypoints,
    with_first_pose,
)
from bayes_body.initial.fitting.report import FirstPose
from bayes_body.initial.stored import restored, stored

__all__ = [
    "FirstPose",
    "Show",
    "apply_first_pose",
    "check_first_pose",
    "first_pose",
    "fit_first_pose",
    "is_fitted",
    "is_posed",
    "load_model",
    "restored",
    "stored",
    "unposed",
    "with_first_keypoints",
    "with_first_pose",
]
