"""The draws of a smoothed run as whole trajectories of its markers. Gait events follow from these only: a filter's draws do not reach over frames."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from bayes_body.errors import input_error
from bayes_body.posterior.blocks import pooled, pose_blocks
from bayes_body.posterior.weighted import markers
from bayes_body.storage.saved_moments import of_each
from bayes_body.storage.saved_run import SavedRun

# So many draws are enough for quantiles, and fit in memory over a long walk.
MOST_DRAWS = 500


def marker_paths(run: SavedRun, names: Sequence[str]) -> Float[np.ndarray, "draw frame marker 3"]:
    """Return the paths of some markers, metres, of at most MOST_DRAWS draws of all runs together.

    Args:
        run: a smoothed run.
        names: names of the body's markers.

    Raises:
        InputError: the run is not smoothed, or its body lacks a marker.
    """
    if not run.smoothed:
        remedy = f"smooth it first with `bayes-body smooth {run.folder}`"
        raise input_error(run.folder, "a run of a filter, whose draws do not reach over frames", "a smoothed run", remedy)
    own = run.model.body.markers.names
    missing = [name for name in names if name not in own]
    if missing:
        raise input_error(f"the body '{run.model.body.name}'", f"no marker {', '.join(missing)}", "one", "add it to the body file's [markers]")
    places = [own.index(name) for name in names]
    found = []
    for piece in pose_blocks(run.tree, width=3 * len(own), variable=run.model.body.variable):
        poses = pooled(piece.poses)
        chosen = poses[:, np.unique(np.linspace(0, poses.shape[1] - 1, MOST_DRAWS).round().astype(int))]
        found.append(of_each(chosen, lambda chunk: markers(run.model, chunk))[:, :, places])
    return np.swapaxes(np.concatenate(found), 0, 1)
