"""The posterior of a window of frames as an ArviZ DataTree, and how far it can be trusted, in sentences."""

from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from bayes_body.density.spaces import space_to_text
from bayes_body.results.posterior.blocks import SPACE
from bayes_body.results.posterior.layout import space_dims, unit_name
from bayes_body.tracking.window import WindowPosterior

if TYPE_CHECKING:
    import xarray as xr

# Vehtari et al. 2021: chains agree below this R-hat, and it can be judged from so many effective draws for each chain.
AGREE, EFFECTIVE = 1.01, 100
# Means further apart than this, in posterior standard deviations, are named.
APART = 0.1


def window_to_datatree(posterior: WindowPosterior) -> "xr.DataTree":
    """Return the draws of a window in ArviZ's form.

    Groups: `posterior` with the state's variables, such as `pose` (chain, draw, frame, dof), where `frame` is the number in the recording and the
    coordinate `unit` says radians or metres; `sample_stats` with `diverging`, `n_steps`, `acceptance_rate`, `lp` (chain, draw) and `step_size`
    (chain); `smoothed` with the smoother's paths (path, frame, dof). The attributes `log_evidence` and `log_evidence_error` are in nats.
    """
    import xarray as xr

    draws, by_draw = posterior.draws, ("chain", "draw")
    stats: dict[str, Any] = {
        "diverging": (by_draw, np.asarray(draws.divergent)),
        "n_steps": (by_draw, np.asarray(draws.leapfrog_steps)),
        "acceptance_rate": (by_draw, np.asarray(draws.acceptance)),
        "lp": (by_draw, np.asarray(draws.log_density)),
        "step_size": (("chain",), np.asarray(draws.step_size)),
    }
    tree = xr.DataTree.from_dict(
        {
            "posterior": _states(posterior, draws.states, by_draw),
            "sample_stats": xr.Dataset(stats, {dim: np.arange(size) for dim, size in zip(by_draw, np.shape(draws.divergent), strict=True)}),
            "smoothed": _states(posterior, posterior.paths, ("path",)),
        }
    )
    value, error = posterior.evidence
    tree.attrs.update(model=posterior.model.definition.name, kernel="nuts", log_evidence=value, log_evidence_error=error)
    return tree


def _states(posterior: WindowPosterior, states: Any, leading: tuple[str, ...]) -> "xr.Dataset":
    """Return whole states (*leading, frame, ...) by variable."""
    import xarray as xr

    arrays, coordinates = {}, {"frame": ("frame", np.array(posterior.frames))}
    for name, values in states.items():
        space = posterior.model.transition.space(name, values.shape[len(leading) + 1 :])
        dims = space_dims(name, space)
        arrays[name] = ((*leading, "frame", *dims), np.asarray(values), {SPACE: space_to_text(space)})
        for dim, axis in zip(dims, space.axes, strict=True):
            if axis.labels:
                coordinates[dim] = (dim, np.array(axis.labels))
            if any(axis.units):
                coordinates[unit_name(dim)] = (dim, np.array(axis.units))
        coordinates |= {dim: (dim, np.arange(size)) for dim, size in zip(leading, values.shape, strict=False)}
    return xr.Dataset(arrays, coordinates)


def window_sentences(posterior: WindowPosterior) -> list[str]:
    """Return the figures of the chains, and what they say, as sentences."""
    draws = posterior.draws
    (chains, count), r_hat = np.shape(draws.divergent), float(np.max(draws.r_hat))
    agree = "the chains agree" if r_hat <= AGREE else f"the chains do not agree (limit {AGREE}); more draws or a longer warm-up are needed"
    least, middle, wanted = float(np.min(draws.effective)), float(np.median(draws.effective)), EFFECTIVE * chains
    advice = "" if least >= wanted else f"; at least {wanted} are needed, so more draws"
    diverged, steps = int(np.sum(draws.divergent)), float(np.mean(draws.leapfrog_steps))
    smoother, sampler = posterior.seconds
    difference, error, name, frame = _largest_difference(posterior)
    sentences = [
        f"R-hat: {r_hat:.3f} for the worst coordinate; {agree}.",
        f"effective draws: {least:.0f} for the worst coordinate, {middle:.0f} in the median, of {chains * count}{advice}.",
        f"divergences: {f'{diverged} of {chains * count} trajectories; a higher target acceptance is needed' if diverged else 'none'}.",
        f"leapfrog steps: {steps:.0f} for each draw, {int(np.sum(draws.leapfrog_steps))} in all, and {int(draws.warm_up_steps)} in warm-up; "
        f"{float(np.mean(draws.acceptance)):.0%} accepted.",
        f"seconds: {sampler:.0f} for the chains, {smoother:.0f} for the smoother, compilation included.",
        f"the smoother's means lie within {difference:.2f} sd of the chains' means; the furthest is {name} in frame {frame}. "
        f"Sampling error of a difference: {error:.2f} sd or more.",
        _evidence_sentence(posterior),
    ]
    return sentences


def _evidence_sentence(posterior: WindowPosterior) -> str:
    value, error = posterior.evidence
    if not np.isfinite(value):
        return "log-evidence: the draws are too few for bridge sampling, or no normal distribution reaches them."
    return f"log-evidence of the window given the frames before it: {value:.2f} ± {error:.2f} nats, by bridge sampling."


def _largest_difference(posterior: WindowPosterior) -> tuple[float, float, str, int]:
    """Return the largest distance between the smoother's and the chains' means of the body's variable, its sampling error, and where it is."""
    variable = posterior.model.body.variable
    space = posterior.model.transition.space(variable, posterior.paths[variable].shape[2:])
    chains, paths = np.asarray(posterior.draws.states[variable], float), np.asarray(posterior.paths[variable], float)
    centre = chains.mean(axis=(0, 1))
    sd, distance = _spread(space, chains.reshape(-1, *chains.shape[2:]), centre), np.abs(_offset(space, paths, centre).mean(axis=0))
    with np.errstate(invalid="ignore", divide="ignore"):
        relative = np.where(sd > 0, distance / sd, 0.0)
    frame, entry = np.unravel_index(np.argmax(relative), relative.shape)
    error = np.sqrt(1 / len(paths) + 1 / float(np.min(posterior.draws.effective)))
    return float(relative.max()), float(error), space.tangent_labels[int(entry)], posterior.frames[int(frame)]


def _offset(space: Any, states: Any, centre: Any) -> Float[np.ndarray, "draw frame entry"]:
    return np.asarray(space.local(np.broadcast_to(centre, states.shape), states))


def _spread(space: Any, states: Any, centre: Any) -> Float[np.ndarray, "frame entry"]:
    return np.sqrt((_offset(space, states, centre) ** 2).mean(axis=0))
