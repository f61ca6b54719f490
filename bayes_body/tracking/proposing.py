"""Detectors look for the parts of a loose-limbed body in every frame, for a kernel that takes proposals (Sigal et al. 2011, 4.2 and 6).

They work on the host while the device is busy with the frames before. All frames have proposals of one form, so that no program is traced again: a
fixed number of components for each part, without weight where fewer were detected (initial/search/proposals.py).
"""

from bayes_body.base.registry import find, names
from bayes_body.density.graph import Mixture
from bayes_body.density.kernel import Kernel
from bayes_body.initial.detection.detect import Detected, detect
from bayes_body.initial.search.proposals import frames_of, proposals_of
from bayes_body.model.build import Model
from bayes_body.recording.observation.frames import Frame
from bayes_body.recording.session.session import Session

type Proposed = tuple[Mixture, ...]


class Proposer:
    """Makes the proposals of a session's frames from what the detectors of a definition find. It may be called from several threads."""

    def __init__(self, session: Session, model: Model):
        """Take the recording, and a model whose body is placed by parts and whose definition names detectors."""
        self.session, self.body, self.detectors = session, model.body, model.definition.detectors
        self._frames = frames_of(model.body)

    def __call__(self, frame: Frame) -> Proposed:
        """Return the proposals of a frame.

        Raises:
            InputError: a file of the session cannot be used.
        """
        return proposals_of(detect(self.session, frame, self.detectors), self.body, self._frames)

    def empty(self) -> Proposed:
        """Return the proposals of a frame in which nothing is detected: they have the form of all others."""
        return proposals_of(Detected({}, {}, None, (), {}), self.body, self._frames)


def proposer_for(session: Session, model: Model, kernel: Kernel) -> Proposer | None:
    """Return what makes the proposals of a session's frames; None if the definition names no detectors, or the kernel takes no proposals."""
    name = getattr(kernel, "kind", "")
    takes = name in names("kernel") and find("kernel", name).takes_proposals
    return Proposer(session, model) if takes and model.definition.detectors else None
