r"""Overlap of the projected mean body with the silhouettes: intersection over union, $|A \cap B| / |A \cup B|$."""

import numpy as np
from jaxtyping import Float

from bayes_body.model.build import Model
from bayes_body.observation.frames import read_frame
from bayes_body.posterior import mean_pose
from bayes_body.session.session import Session
from bayes_body.tracking.draws import Draws, FrameResult
from bayes_body.view.progress import Watch, unwatched
from bayes_body.view.silhouette import intersection_over_union, projected_masks, seen_in


def silhouette_overlap(session: Session, draws: Draws, watch: Watch = unwatched) -> Float[np.ndarray, "run frame camera"]:
    """Overlap of the projected mean body of each run with the silhouettes; NaN where the session has none."""
    return np.stack([frame_overlap(session, draws.model, draws.frames[index], index) for index in watch(range(len(draws.frames)))], axis=1)


def frame_overlap(session: Session, model: Model, result: FrameResult, index: int) -> Float[np.ndarray, "run camera"]:
    """The same of one frame.

    Args:
        session: the recording.
        model: the body.
        result: the frame's particles.
        index: its number.
    """
    poses = mean_pose(result)
    out = np.full((len(poses), len(session.views)), np.nan)
    masks = read_frame(session, index).masks
    if masks is not None:
        model = seen_in(model, session, index)
        for run, pose in enumerate(poses):
            projected = projected_masks(model, pose, session)
            out[run] = [np.nan if b is None else intersection_over_union(a, b) for a, b in zip(projected, masks, strict=True)]
    return out
