"""How far poses that are found by detectors alone are from the pose that comes with a real recording: the man of `bodytrack`, seen by four cameras.

The recording has no truth. The given pose is of the first frame, for a body that is measured; it is accurate to some centimetres.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import bayes_body as bb
from bayes_body.initial.detection.detect import Detected
from bayes_body.initial.search.automatic import poses_of
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.readers.parsec import import_parsec

# The model that would track from the poses; its body is that of the recording.
MODEL = "silhouettes"


def distances_mm(recording: Path, folder: Path, seed: int) -> tuple[float, float] | None:
    """Search the first frame, and return the mean distance of the markers of found poses from the given ones, and that of their mean; None: nobody.

    Args:
        recording: the folder of the recording.
        folder: where its session is written.
        seed: of the search.

    Raises:
        InputError: the recording cannot be read.
    """
    if not folder.exists():
        import_parsec(recording, folder)
    session = bb.load_session(folder)
    model, unposed = bb.load_model(MODEL, session, lambda line: None), bb.unposed(session)
    person = bb.PersonSearch(unposed, seed=seed).window(0)
    if isinstance(person, Detected):
        return None
    poses = jnp.asarray(poses_of(model, unposed, person, 0, seed).draws, model.first_pose.dtype)
    shown = [model.body.markers.names.index(name) for name in MARKERS]
    given, places = (np.asarray(markers, float) for markers in (model.markers(model.first_pose), jax.vmap(model.markers)(poses)))
    of_poses, of_mean = (np.linalg.norm(compared - given, axis=-1)[..., shown].mean() for compared in (places, places.mean(axis=0)))
    return 1000 * float(of_poses), 1000 * float(of_mean)
