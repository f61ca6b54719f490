"""Silhouettes of people whom nobody detected: what the body of the frame before does not explain counts as not seen.

The posterior of the frame before comes from earlier images, so that no image is used twice. A frame is read after the one before is done: nothing is
read ahead of the filter. A smoother and a run that is continued read the same from the stored frames.
"""

from collections.abc import Callable, Generator
from contextlib import closing
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float

from bayes_body.density.kernel import Kernel
from bayes_body.model.build import Model
from bayes_body.recording.observation.frames import Frame
from bayes_body.recording.session.session import Session
from bayes_body.results.metrics.fit import frame_near, seen_in
from bayes_body.results.posterior import mean_pose
from bayes_body.results.posterior.weighted import settled
from bayes_body.tracking.draws import Frames
from bayes_body.tracking.observations import Observed, observations
from bayes_body.tracking.proposing import proposer_for


def follows_body(session: Session, model: Model) -> bool:
    """Whether a model's evidence depends on where the body was in the frame before."""
    return session.segmentation.figures == "near_body" and "silhouettes" in model.reads


def near_body(session: Session, model: Model, filtered: Frames) -> Model:
    """Return the model whose evidence has no figures away from the body of the frame before; the same model if the session does not ask for that.

    Args:
        session: the recording.
        model: starts from the first pose, which takes the place of a frame before the first.
        filtered: the frames of the filters. A frame's evidence needs the one before only.
    """
    if not follows_body(session, model):
        return model

    # All observers of a frame ask at once.
    @lru_cache(maxsize=2)
    def last_poses(index: int) -> tuple[Model, Float[np.ndarray, "run *shape"]]:
        if index == 0:
            return seen_in(model, session, 0), np.asarray(model.initial[model.body.variable], float)[None]
        last = filtered[index - 1]
        placed = settled(replace(model, factors=()), last)
        return seen_in(placed, session, index), mean_pose(last, placed)

    def seeing(observer: Callable[[Any], Any]) -> Callable[[Any], Any]:
        def observe(frame: Frame) -> Any:
            return observer(frame_near(*last_poses(frame.index), session, frame))

        return observe

    return replace(model, observers={name: seeing(observer) for name, observer in model.observers.items()})


def observations_near_body(session: Session, model: Model, kernel: Kernel, frames: range, filtered: Frames) -> Generator[Observed] | None:
    """Yield the data of each frame, once the frame before is among `filtered`; None if the session does not ask for that.

    Args:
        session: the recording.
        model: starts from the first pose.
        kernel: computes the frames; one that takes proposals gets those of the detectors, which see all figures.
        frames: the frames, counted from 0.
        filtered: the frames of the filters, to which the caller adds each one when it is done.

    Raises:
        InputError: a frame cannot be read.
    """
    # `track` refuses more frames than there are.
    if not follows_body(session, model) or frames.stop > session.frames:
        return None
    seeing, proposer = near_body(session, model, filtered), proposer_for(session, model, kernel)

    def arriving() -> Generator[Observed]:
        for index in frames:
            with closing(observations(session, seeing, range(index, index + 1), proposer)) as frame:
                yield from frame

    return arriving()
