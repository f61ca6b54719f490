"""Finding the person again after a loss, for a run: the fit of the body to the picture says where it is off, and detectors find the person."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool

from bayes_body.initial import apply_first_pose
from bayes_body.initial.detection.detect import Detected
from bayes_body.initial.fitting.measurements import FEWEST
from bayes_body.initial.search.automatic import known_markers, poses_of, shows_somebody
from bayes_body.initial.search.person_search import PersonSearch
from bayes_body.model.build import Model
from bayes_body.recording.observation.frames import read_frame
from bayes_body.recording.session.session import Session
from bayes_body.results.metrics.fit import frame_fit, result_fit
from bayes_body.results.metrics.plausibility import is_off
from bayes_body.tracking.draws import FrameResult

# Of the frames that show a person who was not found before, those that are searched.
EVERY = 6


class PersonRecovery:
    """The recovery of a run (`tracking.restarts.Recovery`). The search compiles at the first loss."""

    def __init__(self, session: Session, model: Model, seed: int = 0, show: Callable[[str], None] = print):
        """Prepare to find the person; nothing is read yet.

        Args:
            session: the recording.
            model: the model that tracks it.
            seed: seed of the search.
            show: receives lines for the user.
        """
        self.session, self.model, self.seed, self.show = session, model, seed, show
        self._search: PersonSearch | None = None
        self._told = False

    def off(self, result: FrameResult, frame: int) -> Bool[np.ndarray, " run"]:
        """Return whether each run's mean body is off the person by the limits of `metrics.plausibility`; False where nothing tells."""
        return is_off(result_fit(self.session, self.model, result, frame, to_judge=True))

    def found(self, frame: int, is_first: bool) -> Model | None:
        """Return the model that starts at the person who is found in a frame.

        None if nobody is found, if the found body is off the person by the same limits, if the session has no silhouettes, or if the body has too few
        of the markers. A search takes as long as many frames: where one failed and the person stays in view, only one frame in EVERY is searched.

        Raises:
            InputError: a file of the session cannot be used.
        """
        obstacle = self._obstacle(frame)
        if obstacle:
            if not self._told:
                self.show(f"frame {self.session.frame_number(frame)}: the person was lost, and is not looked for: {obstacle}")
            self._told = True
            return None
        if not shows_somebody(self.session, frame) or (not is_first and frame % EVERY and shows_somebody(self.session, frame - 1)):
            return None
        if self._search is None:
            self._search = PersonSearch(self.session, seed=self.seed)
        detection = self._search.window(frame)
        if isinstance(detection, Detected):
            return None
        placed = apply_first_pose(self.model, self.session, poses_of(self.model, self.session, detection, frame, self.seed))
        pose = np.asarray(placed.initial[placed.body.variable], float)
        if is_off(frame_fit(self.session, placed, pose[None], frame, to_judge=True)).any():
            return None
        self.show(f"frame {self.session.frame_number(frame)}: the person was lost, and is found again; {detection.precision}")
        return placed

    def _obstacle(self, frame: int) -> str | None:
        """Why nobody can be looked for; None if somebody can."""
        if known_markers(self.model) < FEWEST:
            return f"the body has fewer than {FEWEST} of the markers"
        return "the session has no silhouettes" if read_frame(self.session, frame).masks is None else None
