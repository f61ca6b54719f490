"""Weighted means, markers, draws of equal weight and R-hat, of one frame or of all frames.

R-hat does not use weights: it is computed on draws of equal weight, which are resampled from the particles. Draws of equal weight from a posterior's
tree are for other functions without weights, such as those of ArviZ.
"""

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from bayes_body.base.errors import input_error
from bayes_body.density.factor import State, variables
from bayes_body.density.spaces import Space
from bayes_body.model.body.placed_body import placed_markers
from bayes_body.model.body.solids import Body, configuration_space
from bayes_body.model.build import Model
from bayes_body.model.unknowns.apply import Unknowns, with_changes
from bayes_body.results.posterior.agreement import FEWEST_DRAWS, split_rhat
from bayes_body.results.posterior.blocks import around_mean
from bayes_body.results.posterior.layout import WEIGHTS
from bayes_body.results.posterior.resampling import RESAMPLING_SEED, systematic_resampling
from bayes_body.results.posterior.thinning import RHAT, weighted_mean
from bayes_body.tracking.draws import Draws, FrameResult

if TYPE_CHECKING:
    import xarray as xr


@jax.jit
def _positions(body: Body, terms: Unknowns, values: State) -> Float[Array, "draw marker 3"]:
    def positions(state: State) -> Float[Array, "marker 3"]:
        return placed_markers(with_changes(terms, body, variables(state)), state[body.variable])

    return jax.vmap(positions)(values)


def mean_pose(frame: FrameResult, model: Model) -> Float[np.ndarray, "run *shape"]:
    """Return the weighted posterior mean of each run, radians and metres: that of the variable that places the body, in its space."""
    return weighted_mean(frame, model.body.variable, configuration_space(model.body))


def mean_poses(draws: Draws) -> Float[np.ndarray, "run frame *shape"]:
    """Return the weighted posterior mean of each run and frame, radians and metres."""
    return np.stack([mean_pose(frame, draws.model) for frame in draws.frames], axis=1)


def settled(model: Model, frame: FrameResult) -> Model:
    """Return the model with the body and the cameras at their posterior mean in a frame, the mean of all runs."""
    means = {term.name: jnp.asarray(weighted_mean(frame, term.name, term.space).mean(axis=0), term.mean.dtype) for term in model.unknowns}
    return model.settled(means)


def mean_state(frame: FrameResult, model: Model) -> dict[str, Float[np.ndarray, "run *shape"]]:
    """Return the weighted means of each run of the variables on which the markers depend (`Model.placing`)."""
    spaces = {term.name: term.space for term in model.unknowns}
    changes = {name: weighted_mean(frame, name, spaces[name]) for name in model.placing[1:]}
    return {model.body.variable: mean_pose(frame, model), **changes}


def markers(
    model: Model, poses: Float[np.ndarray, "*batch_and_shape"], **changes: Float[np.ndarray, "*batch entry"]
) -> Float[np.ndarray, "*batch marker 3"]:
    """Return the positions of the virtual markers, metres.

    Args:
        model: the model.
        poses: poses, or values of another variable that places the body.
        changes: values of the unknowns that change the body (`Model.placing`), by name. Without them, the body is the subject's.
    """
    shape = configuration_space(model.body).shape
    batch = poses.shape[: poses.ndim - len(shape)]
    terms = tuple(term for term in model.unknowns if term.name in changes)
    flat = {name: jnp.asarray(values.reshape(-1, values.shape[-1])) for name, values in changes.items()}
    positions = np.asarray(_positions(model.body, terms, {model.body.variable: jnp.asarray(poses.reshape(-1, *shape)), **flat}))
    return positions.reshape(*batch, *positions.shape[1:])


def equal_weight_poses(
    frame: FrameResult, index: int, count: int | None = None, seed: int = RESAMPLING_SEED, variable: str = "pose"
) -> Float[np.ndarray, "run draw *shape"]:
    """Return poses of equal weight from one frame's particles, by systematic resampling, in random order.

    Args:
        frame: the frame's particles.
        index: the frame's number, which gives each frame its own random numbers.
        count: number of draws; by default the number of particles.
        seed: seed of the resampling.
        variable: another variable of the state that is drawn instead of poses.
    """
    rng = np.random.default_rng((seed, index))
    runs, particles = frame.log_weights.shape
    number = particles if count is None else count
    values = frame.states[variable]
    out = np.empty((runs, number, *values.shape[2:]), values.dtype)
    for run in range(runs):
        log_weights = frame.log_weights[run].astype(float)
        out[run] = values[run, systematic_resampling(rng, np.exp(log_weights - log_weights.max()), number)]
    return out


def equal_weight_draws(draws: Draws, count: int | None = None, seed: int = RESAMPLING_SEED) -> Float[np.ndarray, "run frame draw *shape"]:
    """Return poses of equal weight of all frames, in memory at once; in each frame `count`, or by default as many as there are particles.

    Of a body that is placed by its parts, they are values of that variable.
    """
    variable = draws.model.body.variable
    return np.stack([equal_weight_poses(frame, index, count, seed, variable) for index, frame in enumerate(draws.frames)], axis=1)


def frame_rhat(frame: FrameResult, index: int, variable: str, space: Space) -> Float[np.ndarray, " dimension"]:
    """Return R-hat of one frame over the runs (`agreement.split_rhat`), in the coordinates of a variable's space around the mean of all runs.

    It is NaN with a single run, with fewer than four particles, and for a dof that never moves.

    Args:
        frame: the frame's particles.
        index: the frame's number.
        variable: the variable, such as `pose`.
        space: where it lives.
    """
    if RHAT + variable in frame.figures:
        return frame.figures[RHAT + variable]
    runs, draws = frame.log_weights.shape
    if runs < 2 or draws < FEWEST_DRAWS:
        return np.full(space.dimension, np.nan)
    equal = equal_weight_poses(frame, index, variable=variable)[:, :, None]
    return split_rhat(around_mean(space, equal, np.zeros(equal.shape[:3])).transpose(2, 0, 1, 3))[0]


def rhat(draws: Draws) -> Float[np.ndarray, "frame dimension"]:
    """Return R-hat of all frames, as `frame_rhat`, of the variable that places the body."""
    variable, space = draws.model.body.variable, configuration_space(draws.model.body)
    return np.stack([frame_rhat(frame, index, variable, space) for index, frame in enumerate(draws.frames)])


STATS, LOG_WEIGHT = "sample_stats", "log_weight"
BY_DRAW = ("chain", "draw", "frame")


def equal_weight(tree: "xr.DataTree", count: int | None = None, seed: int = RESAMPLING_SEED) -> "xr.DataTree":
    """Return the tree with draws of equal weight, resampled from its weighted draws.

    Each chain and frame is resampled systematically, in random order; the variables of a state stay together. A frame whose draws have equal weights
    keeps them in their order. Resampled draws repeat: their number is not an effective sample size, which `bayes_body.diagnose` computes from the
    weights. Draws of two frames are not paths. All frames of the tree are read into memory: of a long recording, select some first, such as
    `tree.sel(frame=[0, 1])`.

    Args:
        tree: from `to_datatree` or `posterior.nc`, or some of its frames.
        count: number of draws of a chain and frame; by default as many as there are.
        seed: seed of the resampling. A frame's draws do not depend on the other frames.

    Raises:
        InputError: the tree has no weights, or `count` is not positive.
    """
    import xarray as xr

    _check(tree, count)
    stored_weights = tree[STATS][LOG_WEIGHT]
    log_weights = stored_weights.expand_dims([dim for dim in BY_DRAW if dim not in stored_weights.dims]).transpose(*BY_DRAW)
    frames = np.asarray(log_weights["frame"] if "frame" in log_weights.coords else np.arange(log_weights.sizes["frame"]))
    chosen = _chosen(np.asarray(log_weights, float), frames, count, seed)
    groups = {name: _taken(group.to_dataset(), chosen) if "draw" in group.dims else group.to_dataset() for name, group in tree.children.items()}
    resampled_tree = xr.DataTree.from_dict(groups)
    resampled_tree.attrs.update({name: value for name, value in tree.attrs.items() if name != WEIGHTS})
    return resampled_tree


def _check(tree: "xr.DataTree", count: int | None) -> None:
    if STATS not in getattr(tree, "children", ()) or LOG_WEIGHT not in tree[STATS]:
        expected = "a tree with weighted draws, from bayes_body.to_datatree or posterior.nc"
        raise input_error("equal_weight: tree", f"no {STATS}/{LOG_WEIGHT}", expected, "use draws without weights as they are")
    if count is not None and count < 1:
        raise input_error("equal_weight: count", str(count), "a whole number from 1 up", "give another number")


def _chosen(
    log_weights: Float[np.ndarray, "chain draw frame"], frames: Int[np.ndarray, " frame"], count: int | None, seed: int
) -> Int[np.ndarray, "chain count frame"]:
    """Return the indices of the draws, for each chain and frame."""
    chains, draws, _ = log_weights.shape
    number = draws if count is None else count
    chosen = np.empty((chains, number, len(frames)), int)
    for place, frame in enumerate(frames):
        rng = np.random.default_rng((seed, int(frame)))
        for chain in range(chains):
            chain_log_weights = log_weights[chain, :, place]
            as_they_are = number == draws and chain_log_weights.max() == chain_log_weights.min()
            chosen[chain, :, place] = (
                np.arange(draws) if as_they_are else systematic_resampling(rng, np.exp(chain_log_weights - chain_log_weights.max()), number)
            )
    return chosen


def _taken(group: "xr.Dataset", chosen: Int[np.ndarray, "chain count frame"]) -> "xr.Dataset":
    """Return a group with the chosen draws; all its arrays have draws."""
    import xarray as xr

    arrays = {}
    for name, values in group.data_vars.items():
        absent = [dim for dim in BY_DRAW if dim not in values.dims]
        values_by_draw = values.expand_dims(absent).variable.transpose(*BY_DRAW, ...)
        index = chosen.reshape(chosen.shape + (1,) * (values_by_draw.ndim - len(BY_DRAW)))
        taken = np.take_along_axis(values_by_draw.values, index, axis=1)
        equal = np.full_like(taken, -np.log(chosen.shape[1])) if name == LOG_WEIGHT else taken
        arrays[name] = xr.Variable(values_by_draw.dims, equal, values.attrs).isel(dict.fromkeys(absent, 0)).transpose(*values.dims)
    labels = {name: values for name, values in group.coords.items() if name != "draw"}
    return xr.Dataset(arrays, labels | {"draw": np.arange(chosen.shape[1])}, group.attrs)
