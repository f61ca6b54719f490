"""Warnings from a diagnosis: a sentence for each limit that is crossed, with the frames, the worst figure and the remedy."""

from collections.abc import Iterator

import numpy as np

from bayes_body.base.errors import InputError
from bayes_body.base.registry import find
from bayes_body.results.posterior.diagnosis import Diagnosis, Thresholds
from bayes_body.results.posterior.joint_sentences import joint_sentences
from bayes_body.results.posterior.mixing_sentences import at_worst, frame_ranges, frames_where, largest, message_sentences, mixing_sentences

__all__ = ["frame_ranges", "sentences"]


def sentences(diagnosis: Diagnosis, thresholds: Thresholds = Thresholds()) -> list[str]:
    """Return one sentence for each limit that is crossed, most serious first; none for a valid run.

    Args:
        diagnosis: a diagnosis from `diagnose`.
        thresholds: the limits.
    """
    lines = [_mode_seeker(diagnosis), _lost(diagnosis), _unseen(diagnosis), _rhat(diagnosis, thresholds), *mixing_sentences(diagnosis, thresholds)]
    lines += [*message_sentences(diagnosis, thresholds), *joint_sentences(diagnosis, thresholds)]
    if not diagnosis.mode_seeker:
        # A mode seeker chooses its powers for a fixed effective sample size: its weights are not importance weights.
        lines += [_ess(diagnosis, thresholds), _pareto_k(diagnosis, thresholds), _evidence(diagnosis, thresholds)]
    lines += [_ancestors(diagnosis, thresholds), *_acceptance(diagnosis, thresholds), _single(diagnosis)]
    return [sentence for sentence in lines if sentence]


def _remedy(diagnosis: Diagnosis, *wanted: str, moves_help: bool = True) -> str:
    """Return a remedy that names the options among `wanted` that the kernel has.

    Args:
        diagnosis: of a run.
        wanted: options of a filter.
        moves_help: whether more moves of the smoother help, if the run is smoothed.
    """
    try:
        kernel = find("kernel", diagnosis.kernel)
        option_names, instead = set(kernel.options.model_fields), kernel.instead
    except InputError:
        option_names, instead = {"particles"}, ""
    # Every kernel takes --particles, even one that has no such option of its own.
    raised = " or ".join(f"--{name}" for name in wanted if name in option_names) or "--particles"
    if diagnosis.smoothed:
        has_moves = moves_help and diagnosis.joint is None
        return f"{'smooth with more --moves, or ' if has_moves else ''}smooth a run with more {raised}"
    return f"raise {raised}, or {instead}" if instead else f"raise {raised}"


def _mode_seeker(diagnosis: Diagnosis) -> str | None:
    if not diagnosis.mode_seeker:
        return None
    return (
        f"the kernel {diagnosis.kernel or 'of this run'} is a mode seeker: the spread of its particles is not a measure of uncertainty, its "
        "effective sample size is fixed by construction, and it estimates no evidence; use a kernel that samples the posterior if you need "
        "one of these."
    )


def _lost(diagnosis: Diagnosis) -> str | None:
    first = diagnosis.first_frame
    lost = diagnosis.lost.any(axis=0)
    if not lost.any():
        return None
    problem = "lost: no particle explained the images, and the filter continued from its prediction"
    return f"{frames_where(lost, first)}: {problem}; look at the images, or {_remedy(diagnosis, 'particles')}."


def _unseen(diagnosis: Diagnosis) -> str | None:
    first = diagnosis.first_frame
    if diagnosis.seen is None or diagnosis.seen.all():
        return None
    blind = [
        f"{name} in {frames_where(~has_image, first)}"
        for name, has_image in zip(diagnosis.cameras, diagnosis.seen.T, strict=True)
        if not has_image.all()
    ]
    remedy = "there only the other cameras, or the motion prior, determine the pose; look at these images"
    return f"nothing seen by camera {'; camera '.join(blind)}: {remedy}."


def _rhat(diagnosis: Diagnosis, thresholds: Thresholds) -> str | None:
    first = diagnosis.first_frame
    worst, finite_counts = largest(diagnosis.rhat), np.isfinite(diagnosis.rhat).sum(axis=1)
    above = (diagnosis.rhat > thresholds.rhat).sum(axis=1)
    crossed = (above > (1 - thresholds.rhat_share) * finite_counts) | (worst > max(thresholds.rhat, thresholds.rhat_single))
    if not crossed.any():
        return None
    frame = int(np.where(crossed, worst, -np.inf).argmax())
    dof = diagnosis.dofs[int(np.nan_to_num(diagnosis.rhat[frame], nan=-np.inf).argmax())]
    figure = f"R-hat up to {worst[frame]:.2f} ({dof} at frame {first + frame}; limit {thresholds.rhat:g})"
    return f"{frames_where(crossed, first)}: the runs disagree, {figure}; {_remedy(diagnosis, 'layers', 'particles', 'moves')}."


def _ess(diagnosis: Diagnosis, thresholds: Thresholds) -> str | None:
    first = diagnosis.first_frame
    worst = diagnosis.ess.min(axis=0)
    limit = max(thresholds.ess, thresholds.ess_share * diagnosis.particles)
    crossed = worst < limit
    if diagnosis.messages is not None:
        # message_sentences says so of frames with fewer.
        crossed &= worst >= thresholds.joint_ess
    if not crossed.any():
        return None
    worst = np.where(crossed, worst, np.inf)
    figure = f"{worst.min():.0f} effective particles of {diagnosis.particles}{at_worst(crossed, first + int(worst.argmin()))} (limit {limit:g})"
    return f"{frames_where(crossed, first)}: {figure}; {_remedy(diagnosis, 'particles', 'moves')}."


def _pareto_k(diagnosis: Diagnosis, thresholds: Thresholds) -> str | None:
    first = diagnosis.first_frame
    worst = largest(diagnosis.pareto_k.T)
    crossed = worst > thresholds.pareto_k
    if not crossed.any():
        return None
    place = at_worst(crossed, first + int(worst.argmax()))
    figure = f"a few weights dominate the estimate, Pareto k {worst.max():.2f}{place} (limit {thresholds.pareto_k:g})"
    return f"{frames_where(crossed, first)}: {figure}; {_remedy(diagnosis, 'particles', 'moves')}."


def _evidence(diagnosis: Diagnosis, thresholds: Thresholds) -> str | None:
    first = diagnosis.first_frame
    sd = diagnosis.evidence_sd
    if not sd > thresholds.evidence_sd:
        return None
    by_frame = np.nan_to_num(diagnosis.evidence_sd_frames, nan=-np.inf)
    runs, most = len(diagnosis.log_evidence), first + by_frame.argmax()
    figure = f"sd {sd:.1f} nats over {runs} runs (limit {thresholds.evidence_sd:g}), most at frame {most}"
    return f"log-evidence: {figure}: too imprecise to compare models; {_remedy(diagnosis, 'particles', 'moves', moves_help=False)}."


def _ancestors(diagnosis: Diagnosis, thresholds: Thresholds) -> str | None:
    first = diagnosis.first_frame
    worst = diagnosis.ancestors[diagnosis.lags.index(1)].min(axis=0)
    crossed = worst < min(thresholds.ancestors, diagnosis.particles)
    if not crossed.any():
        return None
    place = at_worst(crossed, first + int(worst.argmin()))
    figure = f"all particles descend from {worst.min():.0f} of the frame before{place} (limit {thresholds.ancestors:g})"
    return f"{frames_where(crossed, first)}: {figure}; {_remedy(diagnosis, 'particles', 'moves')}."


def _acceptance(diagnosis: Diagnosis, thresholds: Thresholds) -> Iterator[str]:
    first = diagnosis.first_frame
    rates = diagnosis.acceptance_rate.transpose(1, 0, 2).reshape(diagnosis.acceptance_rate.shape[1], -1)
    is_finite = ~np.isnan(rates)
    mean = np.divide(np.where(is_finite, rates, 0).sum(axis=1), is_finite.sum(axis=1), out=np.full(len(rates), np.nan), where=is_finite.any(axis=1))
    low, high = thresholds.acceptance
    for crossed, place, limit, meaning in (
        (mean < low, np.where(np.isnan(mean), np.inf, mean).argmin(), low, "the moves hardly change the particles"),
        (mean > high, np.where(np.isnan(mean), -np.inf, mean).argmax(), high, "the moves are too short to explore the posterior"),
    ):
        if crossed.any():
            figure = f"{mean[place]:.2f} of the Markov moves accepted{at_worst(crossed, first + int(place))} (limit {limit:g})"
            remedy = (
                _remedy(diagnosis, "moves", "particles")
                if diagnosis.mixing is None
                else "change the step, with --set step=... or --set target_acceptance=0.8"
            )
            yield f"{frames_where(crossed, first)}: {figure}, {meaning}; {remedy}."


def _single(diagnosis: Diagnosis) -> str | None:
    if diagnosis.ess.shape[0] > 1:
        return None
    return "a single run cannot show whether another run would agree; use --runs 2 or more."
