"""The image of a run's recording behind a picture. A stranger's run may name any file of this machine: only the run's own images are shown."""

from typing import TYPE_CHECKING

import numpy as np
from cv2.typing import MatLike

from bayes_body.view.overlay import backdrop
from bayes_body.view.windows import EMPTY

if TYPE_CHECKING:
    from bayes_body.results.storage.saved_run import SavedRun


def run_backdrop(run: "SavedRun", frame: int, camera: int) -> tuple[MatLike, str]:
    """Return a camera's image of a frame and an empty note; a dark one with a note if there is none, or if it is not that of the time of the run."""
    view = run.session.views[camera]
    if not run.changed_inputs & {f"images of {view.camera.name}", f"video of {view.camera.name}"}:
        return backdrop(run.session, frame, view)
    width, height = view.camera.size_px
    return np.full((height, width, 3), EMPTY, np.uint8), "\nno image: its file is not the one of the time of the run"
