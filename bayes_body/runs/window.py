"""The joint posterior of a window of frames of a run on disk, by NUTS."""

from pathlib import Path

import jax

from bayes_body.base.errors import input_error
from bayes_body.results.storage import FrameFiles
from bayes_body.results.storage.names import FRAMES_FOLDER
from bayes_body.results.storage.saved_run import load_run
from bayes_body.runs.other_figures import near_body
from bayes_body.tracking.window import Prior, WindowPosterior, window_posterior


def window_of_run(
    folder: Path | str,
    frames: int,
    first: int | None = None,
    seed: int = 0,
    prior: Prior = "gaussian",
    paths: int = 250,
    moves: int = 3,
    **options: int | float | str,
) -> WindowPosterior:
    """Draw trajectories through consecutive frames from their joint posterior.

    Args:
        folder: the run of a filter. For a smoothed run, it is the run that was smoothed.
        frames: number of frames.
        first: number of the first one, which is not the run's first; by default the last frames of the run, for which all images count.
        seed: seed of everything random.
        prior: `gaussian` or `particles` (`window_posterior`).
        paths: number of the smoother's paths for each run of the filter.
        moves: number of the smoother's moves of each state.
        options: those of `kernels.window.Options`: chains, warm_up, draws, metric, target_acceptance.

    Raises:
        InputError: there is no such run, its recording has changed, its kernel seeks modes, or the window cannot be sampled (`window_posterior`).
    """
    with load_run(folder) as chosen_run:
        source = chosen_run.smoothing["folder"] if chosen_run.smoothed else folder
    with load_run(source) as run:
        if run.changed_inputs:
            problem = f"{', '.join(sorted(run.changed_inputs))}: changed or gone since the run was made"
            raise input_error(run.folder, problem, "the recording of the run", "put it back")
        if run.mode_seeker:
            raise input_error("the run", "its kernel seeks modes", "a sample of the posterior", "track again with --kernel tempered, for one")
        filtered = FrameFiles(run.folder / FRAMES_FOLDER, run.id)
        begin = run.frames - frames if first is None else first - run.first_frame
        window = range(begin, begin + frames)
        model = near_body(run.session, run.model, filtered)
        return window_posterior(run.session, model, filtered, window, jax.random.key(seed), prior, paths, moves, **options)
