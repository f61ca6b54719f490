"""Choose the model for a session if the user names none; it depends on the data of the session."""

from typing import NamedTuple

from bayes_body.base.errors import input_error
from bayes_body.recording.observation.silhouettes import has_silhouettes
from bayes_body.recording.session.read import FILE_NAME
from bayes_body.recording.session.session import Session

KEYPOINT_MODEL, SILHOUETTE_MODEL, ONE_CAMERA_MODEL = "keypoints", "silhouettes", "walker_from_the_side"
ONE_VIEW = "in one view depth is uncertain: expect wide intervals"
LEGS = "it tracks the legs only, of a person who walks past the camera"


class ModelChoice(NamedTuple):
    """A definition's name, the reason as part of a sentence, and what the model cannot do for this session; empty if there is nothing to say."""

    model: str
    reason: str
    limits: str = ""

    @property
    def sentence(self) -> str:
        """The line that `bayes-body track` prints."""
        return "; ".join([f"model      {self.model}, because {self.reason}", *([self.limits] if self.limits else []), "--model names another."])


def choose_model(session: Session) -> ModelChoice:
    """Return the model that the data call for: keypoints, else silhouettes, of one still camera or of several cameras.

    All sample the posterior; a mode seeker is never chosen.

    Raises:
        InputError: the session has neither keypoints nor silhouettes.
    """
    count, cameras = sum(view.keypoints is not None for view in session.views), len(session.views)
    if count:
        return ModelChoice(
            KEYPOINT_MODEL, f"{count} of {cameras} cameras {'has' if count == 1 else 'have'} keypoints", ONE_VIEW if count == 1 else ""
        )
    source = _silhouette_source(session)
    if source and cameras == 1 and not session.moves:
        return ModelChoice(
            ONE_CAMERA_MODEL, f"the session has one still camera, with silhouettes ({source}) and no keypoints", f"{LEGS}, and {ONE_VIEW}"
        )
    if source:
        return ModelChoice(SILHOUETTE_MODEL, f"the session has silhouettes ({source}) and no keypoints", ONE_VIEW if cameras == 1 else "")
    problem, expected = "neither keypoints nor silhouettes", "one of the two in every frame"
    remedy = "import the recording with --keypoints or --masks, give each [[camera]] the `background` of an empty scene, or name a --model"
    raise input_error(session.folder / FILE_NAME, problem, expected, remedy)


def _silhouette_source(session: Session) -> str:
    """Return the source of the silhouettes in words; empty if there can be none. The background of a moving camera cannot be learned."""
    without = [view for view in session.views if view.masks is None]
    if not without:
        return "masks"
    learned = [view for view in without if view.background is None]
    if not has_silhouettes(session) or any(view.path is not None for view in learned):
        return ""
    return "from a background that is learned from the frames" if learned else "from an image of the empty scene"
