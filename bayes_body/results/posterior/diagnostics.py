"""Weighted diagnostics of every frame of a run, read block by block, and warnings from them as sentences."""

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
from jaxtyping import Bool, Float, Int

from bayes_body.results.posterior.agreement import independent_draws, rhat_of_block
from bayes_body.results.posterior.blocks import BLOCK, coordinate_blocks, stored_spaces, weights_of_runs
from bayes_body.results.posterior.diagnosis import LAGS, MODES, Diagnosis, Thresholds, declared_sample, first_frame_of
from bayes_body.results.posterior.genealogy import unique_ancestors
from bayes_body.results.posterior.joint import joint_of, worst_of_joint
from bayes_body.results.posterior.message_passing import message_passing_of, worst_of_messages
from bayes_body.results.posterior.mixing import mixing_of, thinned_figure
from bayes_body.results.posterior.pareto import pareto_shape
from bayes_body.results.posterior.sentences import frame_ranges, sentences
from bayes_body.results.posterior.thinning import INDEPENDENT, OF_ALL, RHAT

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Diagnosis", "Thresholds", "diagnose", "frame_ranges", "sentences", "worst_figures"]


class HasTree(Protocol):
    """An object with a posterior, such as a `SavedRun`."""

    @property
    def tree(self) -> "xr.DataTree":
        """A tree made by `to_datatree`."""
        ...


def diagnose(run: "HasTree | xr.DataTree", block: int = BLOCK) -> Diagnosis:
    """Return the figures of a run. Apart from these figures, memory does not grow with the run's length.

    Args:
        run: a `SavedRun`, or the tree of a posterior.
        block: largest number of frames read at a time.
    """
    import xarray as xr

    tree = run if isinstance(run, xr.DataTree) else run.tree
    figures = _of_all(tree) if "thinned_from" in tree.attrs else _of_draws(tree, block)
    (cameras, has_image), mixing = _image_presence(tree), mixing_of(tree, block)
    return Diagnosis(
        kernel=str(tree.attrs.get("kernel", "")),
        particles=int(tree.attrs.get("thinned_from", tree["posterior"].sizes["draw"])),
        dofs=tuple(label for space in stored_spaces(tree).values() for label in space.tangent_labels),
        ess=figures.ess if mixing is None else np.minimum(figures.ess, mixing.ess.min(axis=-1)),
        pareto_k=figures.pareto_k,
        ancestors=figures.ancestors,
        lags=LAGS,
        acceptance_rate=_acceptance_rate(tree),
        rhat=figures.rhat,
        independent_draws=figures.independent_draws,
        log_evidence=np.asarray(tree["filter"]["log_evidence"], float),
        lost=np.asarray(tree["filter"]["lost"], bool),
        seen=has_image,
        cameras=cameras,
        mixing=mixing,
        messages=message_passing_of(tree),
        smoothed=bool(tree.attrs.get("smoothed", 0)),
        first_frame=first_frame_of(tree),
        declared_sample=declared_sample(tree),
        attempts=_attempts(tree),
        attempt_k=_attempt_k(tree),
        joint=joint_of(tree),
    )


class _Figures(NamedTuple):
    """The figures that need all particles, as `Diagnosis` has them; `ess` by the weights alone."""

    ess: Float[np.ndarray, "run frame"]
    pareto_k: Float[np.ndarray, "run frame"]
    ancestors: Float[np.ndarray, "lag run frame"]
    rhat: Float[np.ndarray, "frame dof"]
    independent_draws: Float[np.ndarray, " frame"]


def _of_draws(tree: "xr.DataTree", block: int) -> _Figures:
    """Return the figures of the draws."""
    pieces = [
        (effective_sample_sizes(b.log_weights), pareto_shape(b.log_weights.transpose(0, 2, 1)), rhat_of_block(b), independent_draws(b))
        for b in coordinate_blocks(tree, block=block, spaces=stored_spaces(tree))
    ]
    ess, shapes, rhats, independent = zip(*pieces, strict=True)
    return _Figures(
        np.concatenate(ess, axis=1), np.concatenate(shapes, axis=1), unique_ancestors(tree, LAGS), np.concatenate(rhats), np.concatenate(independent)
    )


def _of_all(tree: "xr.DataTree") -> _Figures:
    """Return the figures that were computed of all particles, before a run was thinned. Ancestors further back are unknown."""
    group = tree["filter"]
    ess, pareto_k, ancestor_counts, independent = (np.asarray(group[OF_ALL + name], float) for name in ("ess", "pareto_k", "ancestors", INDEPENDENT))
    ancestors = np.full((len(LAGS), *ancestor_counts.shape), np.nan)
    ancestors[LAGS.index(1)] = ancestor_counts
    rhat = thinned_figure(tree, RHAT)
    return _Figures(ess, pareto_k, ancestors, np.full((len(independent), 0), np.nan) if rhat is None else rhat, independent)


def worst_figures(diagnosis: Diagnosis, thresholds: Thresholds = Thresholds()) -> dict[str, float | None]:
    """Return the worst figure of each diagnostic over runs, frames and dofs; None for a figure that does not exist.

    A mode seeker has no Pareto k, because its weights are not importance weights.
    """
    weighted = not diagnosis.mode_seeker
    finite_values = diagnosis.rhat[np.isfinite(diagnosis.rhat)]
    figures = {
        "rhat_share": float((finite_values <= thresholds.rhat).mean()) if finite_values.size else np.nan,
        "independent_draws_min": _extreme(np.min, diagnosis.independent_draws),
        "ancestors_min": _extreme(np.min, diagnosis.ancestors[0]),
        "pareto_k_max": _extreme(np.max, diagnosis.pareto_k) if weighted else np.nan,
        "acceptance_rate": _extreme(np.median, diagnosis.acceptance_rate),
        "log_evidence_sd": diagnosis.evidence_sd,
    }
    if diagnosis.attempts is not None:
        figures |= dict(zip(("redone_starts_share", "redone_tempered_share"), diagnosis.redone, strict=True))
        figures["normal_doubtful_share"] = diagnosis.doubtful_share(thresholds.pareto_k)
    if diagnosis.joint is not None:
        figures |= worst_of_joint(diagnosis.joint, thresholds.pareto_k)
    if diagnosis.mixing is not None:
        figures |= {"markov_rhat_max": _extreme(np.max, diagnosis.mixing.rhat), "divergences": float(diagnosis.mixing.divergences.sum())}
    if diagnosis.messages is not None:
        figures |= worst_of_messages(diagnosis.messages)
    return {name: value if np.isfinite(value) else None for name, value in figures.items()}


def _extreme(function: Callable[[np.ndarray], np.floating], values: np.ndarray) -> float:
    finite_values = values[np.isfinite(values)]
    return float(function(finite_values)) if finite_values.size else float("nan")


def effective_sample_sizes(log_weights: Float[np.ndarray, "run draw frame"]) -> Float[np.ndarray, "run frame"]:
    """Return the effective sample sizes, 1 / Σ w² of normalised weights, particles."""
    return 1 / (weights_of_runs(log_weights) ** 2).sum(axis=1)


def _acceptance_rate(tree: "xr.DataTree") -> Float[np.ndarray, "run frame layer"]:
    group = tree["filter"]
    if "acceptance_rate" in group:
        return np.asarray(group["acceptance_rate"], float)
    return np.full((*group["log_evidence"].shape, 1), np.nan)


def _attempts(tree: "xr.DataTree") -> Int[np.ndarray, "run frame"] | None:
    group = tree["filter"]
    return np.asarray(group[f"{MODES}attempt"], int) if f"{MODES}attempt" in group else None


def _attempt_k(tree: "xr.DataTree") -> Float[np.ndarray, "run frame"] | None:
    group = tree["filter"]
    return np.asarray(group[f"{MODES}pareto_k"], float) if f"{MODES}pareto_k" in group else None


def _image_presence(tree: "xr.DataTree") -> tuple[tuple[str, ...], Bool[np.ndarray, "frame camera"] | None]:
    group = tree["filter"]
    if "seen" not in group:
        return (), None
    has_image = group["seen"].transpose("frame", "camera")
    names = has_image["camera"] if "camera" in has_image.coords else np.arange(has_image.sizes["camera"])
    return tuple(np.asarray(names).astype(str).tolist()), np.asarray(has_image, bool)
