"""Draws as an ArviZ DataTree, and statistics that take their weights into account."""

from bayes_body.results.posterior.central import CentralPose, central_pose
from bayes_body.results.posterior.stream import save_posterior, stream_posterior, to_datatree
from bayes_body.results.posterior.weighted import (
    equal_weight,
    equal_weight_draws,
    equal_weight_poses,
    frame_rhat,
    markers,
    mean_pose,
    mean_poses,
    rhat,
)

__all__ = [
    "CentralPose",
    "central_pose",
    "equal_weight",
    "equal_weight_draws",
    "equal_weight_poses",
    "frame_rhat",
    "markers",
    "mean_pose",
    "mean_poses",
    "rhat",
    "save_posterior",
    "stream_posterior",
    "to_datatree",
]
