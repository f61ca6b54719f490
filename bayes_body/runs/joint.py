"""The joint posterior of all frames in a run: what is checked before it begins, its paths, and their place in a store."""

from contextlib import closing

import jax
import numpy as np

from bayes_body.base.errors import input_error
from bayes_body.base.shapes import Key
from bayes_body.kernels.paths.smoother import JointOptions
from bayes_body.model.build import Model
from bayes_body.recording.session.session import Session
from bayes_body.runs.progress import doing_line
from bayes_body.runs.size import gigabytes, memory_bytes
from bayes_body.tracking.draws import Frames, FrameStore
from bayes_body.tracking.joint import check_model, refuse_restarts, solve
from bayes_body.tracking.observations import observations
from bayes_body.tracking.smooth import LastFirst

# Matrices of a frame that are in memory during a step and those that stay of a run, copies of its paths besides those that stay, and of its data.
MATRICES, RUN_MATRICES, PATH_COPIES, DATA_COPIES, NUMBER_BYTES = 13, 4, 4, 2, 4


def check_joint(session: Session, model: Model, frames: int, runs: int, draws: int, restarted: list[int]) -> None:
    """Check, before anything is written, that the joint posterior of all frames can be computed.

    Args:
        session: the recording.
        model: the model of the filter.
        frames: number of its frames.
        runs: number of its runs.
        draws: number of paths of each run.
        restarted: numbers of the frames in which a run started anew.

    Raises:
        InputError: a run started anew, the model has no such Gaussian, or the machine has too little memory.
    """
    refuse_restarts(restarted)
    check_model(model)
    with closing(observations(session, model, range(1))) as first:
        data = sum(leaf.nbytes for leaf in jax.tree.leaves(dict(next(first).data)))
    needed, available = joint_bytes(model, frames, runs, draws, data), memory_bytes()
    if available is not None and needed > available:
        problem = f"about {gigabytes(needed)} of memory for {frames} frames at once"
        remedy = "track fewer frames, give fewer --draws, or smooth by paths, such as --start ensemble"
        raise input_error("the joint posterior of all frames", problem, f"at most the {gigabytes(available)} that there are", remedy)


def joint_bytes(model: Model, frames: int, runs: int, draws: int, data: int) -> int:
    """Return about how much memory the frames need at once, bytes; `data` is that of one frame's data."""
    numbers = sum(int(np.size(leaf)) for leaf in jax.tree.leaves(dict(model.initial)))
    matrices = NUMBER_BYTES * numbers**2 * (MATRICES + RUN_MATRICES * (runs - 1))
    paths = NUMBER_BYTES * draws * numbers * (PATH_COPIES + runs)
    return frames * (matrices + paths + DATA_COPIES * data)


def joint_paths(session: Session, model: Model, options: JointOptions, filtered: Frames, key: Key, into: FrameStore, bar: bool) -> LastFirst:
    """Draw paths from one Gaussian of all frames, and return their frames in the order of time.

    Args:
        session: the recording.
        model: the model with which the session was filtered.
        options: the number of paths.
        filtered: the frames of the filters.
        key: random key of all paths.
        into: the store of the frames, the last frame first. If it has all of them, nothing is computed.
        bar: whether to show the progress on standard error.

    Raises:
        InputError: as from `tracking.joint.solve`, or a frame cannot be stored.
    """
    if len(into) < len(filtered):
        with doing_line("joint posterior", bar) as show:
            paths = solve(session, model, filtered, key, options.draws, show).frames
            for index in range(len(filtered) - 1 - len(into), -1, -1):
                into.append(paths[index])
    return LastFirst(into)
