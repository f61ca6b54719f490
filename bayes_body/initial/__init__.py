"""The first pose: from angles as they are, from markers or keypoints by a robust fit within the body's limits."""

from bayes_body.initial.first import apply_first_pose, first_pose, is_fitted, with_first_pose
from bayes_body.initial.report import FirstPose
from bayes_body.initial.stored import restored, stored

__all__ = ["FirstPose", "apply_first_pose", "first_pose", "is_fitted", "restored", "stored", "with_first_pose"]
