"""What the live page shows: the body in the last frame, and the dofs over the last second, with means and 90 % intervals.

Nothing is computed while a frame is tracked. The figures of a frame are computed when the page asks, for at most FRAMES frames of the last second,
from DRAWS draws of equal weight. So a page that nobody looks at costs nothing.
"""

import json
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from bayes_body.model.body.solids import configuration_space, part_axes
from bayes_body.model.build import Model
from bayes_body.recording.session.session import Session
from bayes_body.results.posterior import equal_weight_poses
from bayes_body.results.posterior.diagnosis import Thresholds
from bayes_body.results.posterior.weighted import frame_rhat
from bayes_body.tracking.draws import FrameResult
from bayes_body.tracking.track import Progress
from bayes_body.view.colours import side_of

# Seconds that the page shows, frames of them, and draws of a frame, all runs together.
SHOWN_S, FRAMES, DRAWS = 1.0, 10, 200
LEVELS = (0.05, 0.95)
LIMITS = Thresholds()
DECIMALS = 4


class StoredFrame(NamedTuple):
    """A frame of the last second: its number in the run, when it was stored (`time.monotonic`), its draws, and the delays at that moment."""

    frame: int
    stored_s: float
    result: FrameResult
    delays: Mapping[str, float]


class LivePage:
    """The last second of a run. The tracker's thread adds frames, the server's threads read them.

    Args:
        model: the model that tracks.
        session: the recording, from the run's first frame on.
    """

    def __init__(self, model: Model, session: Session):
        self._model, self._session = model, session
        self._stored = deque[StoredFrame]()
        self._dofs = dict[int, dict[str, Any]]()
        self._lock = threading.Lock()
        self._part_axes = jax.jit(jax.vmap(part_axes, (None, 0)))

    def add(self, progress: Progress, delays: Mapping[str, float]) -> None:
        """Add a frame that was just stored.

        Args:
            progress: of the frame, with its result.
            delays: `delay_s`, `waiting` and `frames_per_second` at that moment.
        """
        if progress.result is None:
            return
        now_s = time.monotonic()
        with self._lock:
            self._stored.append(StoredFrame(progress.frame - 1, now_s, progress.result, delays))
            while now_s - self._stored[0].stored_s > SHOWN_S:
                self._stored.popleft()

    def state(self) -> dict[str, Any]:
        """Return the last second in numbers that JSON has: metres, degrees, seconds; None for a number that is not finite.

        - `title`, `up` (0, 1 or 2, the axis that points up), `dofs` and their `units`, `sides` of the parts: l, r or empty;
        - `frames`, the last one at the end: `ago_s` before it, and `mean`, `low` and `high` of the dofs, if the body is placed by its dofs;
        - of the last frame, if there is one: `number` in the recording, `parts` with `mean`, `low` and `high` of the ends of each part's axis
          (part, 2, 3), `delay_s`, `waiting`, `frames_per_second`, `since_s` it was stored, `ess` (smallest of the runs), `draws`, and `warnings`.
        """
        with self._lock:
            stored = list(self._stored)
        places = sorted({round(place) for place in np.linspace(0, len(stored) - 1, min(FRAMES, len(stored)))})
        shown = [stored[place] for place in places]
        # Two pages at once may compute a frame twice, which does no harm.
        self._dofs = dofs = {entry.frame: self._dofs.get(entry.frame) or self._dof_figures(entry) for entry in shown}
        body, topology = self._model.body, self._model.body.skeleton.topology
        by_angles = body.variable == "pose"
        state: dict[str, Any] = {
            "title": self._session.title,
            "up": "xyz".index(self._session.up),
            "dofs": list(topology.dof_names) if by_angles else [],
            "units": ["degrees" if unit == "rad" else unit for unit in topology.dof_units] if by_angles else [],
            "sides": [side_of(name) for name in body.topology.names],
            "frames": [{"ago_s": round(shown[-1].stored_s - entry.stored_s, DECIMALS), **dofs[entry.frame]} for entry in shown],
        }
        return _finite(state | (self._last_figures(shown[-1]) if shown else {}))

    def json(self) -> str:
        """Return `state` as JSON."""
        return json.dumps(self.state(), allow_nan=False)

    def _last_figures(self, entry: StoredFrame) -> dict[str, Any]:
        ends = np.asarray(self._part_axes(self._model.body, self._draws(entry)), float)
        return {
            "number": self._session.frame_number(entry.frame),
            "parts": _summary(ends),
            **entry.delays,
            "since_s": time.monotonic() - entry.stored_s,
            "ess": float(np.min(entry.result.info.ess)),
            "draws": entry.result.log_weights.shape[1],
            "warnings": list(self._warnings(entry)),
        }

    def _dof_figures(self, entry: StoredFrame) -> dict[str, Any]:
        """Mean and interval of each dof in a frame, degrees and metres; angles without limits are near their first draw, not cut at 180 degrees."""
        body = self._model.body
        if body.variable != "pose":
            return {}
        draws = self._draws(entry).astype(float)
        topology = body.skeleton.topology
        angular = np.asarray(topology.angular)
        turns = np.where(angular, np.round((draws - draws[0]) / (2 * np.pi)), 0.0)
        return _summary((draws - 2 * np.pi * turns) * np.where(angular, 180 / np.pi, 1.0))

    def _draws(self, entry: StoredFrame) -> Float[np.ndarray, "draw *shape"]:
        count = max(DRAWS // len(entry.result.log_weights), 1)
        draws = equal_weight_poses(entry.result, entry.frame, count, variable=self._model.body.variable)
        return draws.reshape(-1, *draws.shape[2:])

    def _warnings(self, entry: StoredFrame) -> Iterator[str]:
        result, body = entry.result, self._model.body
        if not result.seen.any():
            yield "No camera saw this frame: the pose is a prediction."
        elif result.lost:
            yield "No draw explains this frame: the person may be lost."
        ess, draws = float(np.min(result.info.ess)), result.log_weights.shape[1]
        if ess < LIMITS.ess_share * draws:
            yield f"Only {ess:.0f} of {draws} draws are effective: intervals of this frame are rough."
        rhat = frame_rhat(result, entry.frame, body.variable, configuration_space(body)) if len(result.log_weights) > 1 else np.zeros(0)
        if np.any(rhat > LIMITS.rhat_single):
            yield f"R-hat is {np.nanmax(rhat):.2f}: the runs disagree on this frame."


def _summary(draws: Float[np.ndarray, "draw *shape"]) -> dict[str, Any]:
    low, high = np.quantile(draws, LEVELS, axis=0)
    return {name: np.round(values, DECIMALS).tolist() for name, values in (("mean", draws.mean(axis=0)), ("low", low), ("high", high))}


def _finite(value: Any) -> Any:
    """Return the value with None in place of numbers that JSON does not have."""
    if isinstance(value, dict):
        return {name: _finite(entry) for name, entry in value.items()}
    if isinstance(value, list):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
