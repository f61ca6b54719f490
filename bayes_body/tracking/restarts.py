"""Runs that have lost the person start anew where the person is found again.

A run is lost if for FRAMES_OFF frames in a row its body is off the person, no particle explains the frame, or no camera sees it. After such a gap the
particles are only a prediction, which may overlap the person and still be wrong by a step. At the next frame in which the person is found, they are
replaced by the first poses that were found there. The stored frames determine in which frames a run is off, and the search has its own seed. A run
that continues therefore restarts at the same frames, in the same way.
"""

from typing import Protocol

import jax
import numpy as np
from jaxtyping import Bool, Int

from bayes_body.base.shapes import Key
from bayes_body.density.factor import Particles
from bayes_body.kernels.batching import everywhere
from bayes_body.model.build import Model
from bayes_body.tracking.draws import FrameResult, FrameStore

# A single bad silhouette is no loss.
FRAMES_OFF = 3
# Folded into a run's key before the frame's number, so that the random numbers of a restart differ from those of the frame.
AGAIN = 2**32 - 2


class Recovery(Protocol):
    """Says where the body is off the person, and finds the person again."""

    def off(self, result: FrameResult, frame: int) -> Bool[np.ndarray, " run"]:
        """Return whether each run's body is off the person in a frame; False if the frame does not show the person."""
        ...

    def found(self, frame: int, is_first: bool) -> Model | None:
        """Return the model that starts from the person found in a frame; None if nobody was found.

        `is_first` says that a run has been lost only since the frame before, so that there was no earlier search.
        """
        ...


class Restarts:
    """Counts the frames in which each run is off, and restarts lost runs."""

    def __init__(self, recovery: Recovery, runs: int, stored: FrameStore):
        """Count the last stored frames too, if there are any."""
        self.recovery = recovery
        self.frames_off: Int[np.ndarray, " run"] = np.zeros(runs, int)
        for frame in range(max(0, len(stored) - 2 * FRAMES_OFF), len(stored)):
            self.watch(stored[frame], frame)

    def watch(self, result: FrameResult, frame: int) -> None:
        """Count a frame that was tracked."""
        previous_counts = np.where(result.restarted, 0, self.frames_off) if result.restarted.any() else self.frames_off
        self.frames_off = np.where(self.recovery.off(result, frame) | np.asarray(result.info.lost, bool), previous_counts + 1, 0)

    def restart(self, frame: int, filters: list[Particles], keys: list[Key]) -> Bool[np.ndarray, " run"]:
        """Replace the particles of lost runs by poses of the person found in a frame, if any; return whether each run was restarted."""
        lost = self.frames_off >= FRAMES_OFF
        model = self.recovery.found(frame, bool((self.frames_off == FRAMES_OFF).any())) if lost.any() else None
        if model is None:
            return np.zeros(0, bool)
        for run in np.flatnonzero(lost):
            key = jax.random.fold_in(jax.random.fold_in(keys[run], AGAIN), frame)
            filters[run] = everywhere(model.start(filters[run].log_weights.shape[0], key))
        return lost
