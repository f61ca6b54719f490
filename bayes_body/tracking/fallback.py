"""The fallback of a kernel: a program for itself, compiled when a frame of a recording first needs it. Most recordings never do.

Each run decides alone, and gets the random numbers of its frame. So a filter that continues from stored frames decides and draws the same.
"""

import time
from collections.abc import Sequence
from typing import Any

from bayes_body.base.shapes import Key
from bayes_body.density.density import Density
from bayes_body.density.factor import Particles
from bayes_body.density.kernel import FilterInfo, Kernel, done_again
from bayes_body.tracking.program import Layout, Step, dispatch, parts_of, program_from

# One run, on all devices.
ALONE = Layout(1, 0)


class Fallback:
    """Does the frames in which a kernel fails.

    Args:
        kernel: any kernel. Without a fallback, nothing is done again.
    """

    def __init__(self, kernel: Kernel):
        self._parts = parts_of(kernel)
        self._step: Step | None = None

    def replace_failed(
        self,
        outcomes: list[tuple[Particles, FilterInfo]],
        filters: list[Particles],
        keys: Sequence[Key],
        frame: Any,
        previous: Sequence[Particles],
        densities: Sequence[Density],
    ) -> float:
        """Replace the outcomes of the runs that failed in a frame, and their particles for the next frame.

        Args:
            outcomes: the results of each run on the host; those of failed runs are replaced.
            filters: the particles of each run for the next frame; those of failed runs are replaced.
            keys: the keys of the runs.
            frame: the number of the frame.
            previous: the particles of the runs before the frame.
            densities: the density of each run.

        Returns:
            Seconds until the program was compiled; 0 if it was there already, or nothing failed.
        """
        waited = 0.0
        if self._parts is None:
            return waited
        for run, (_, info) in enumerate(outcomes):
            if not self._parts.fails(info):
                continue
            key, index, particles, density = ALONE.place((keys[run], frame, previous[run], densities[run]))
            if self._step is None:
                began = time.perf_counter()
                self._step = program_from(None, self._parts.fallback, ALONE, key, particles, density)
                waited = time.perf_counter() - began
            ((filtered, redone),), (filters[run],) = dispatch(self._step, ALONE, [key], index, [particles], [density]).fetch()
            outcomes[run] = filtered, done_again(info, redone)
        return waited
