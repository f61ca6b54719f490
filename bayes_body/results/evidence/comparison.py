"""Models in the order of their evidence: the table, the verdict in a sentence, and what a reader must know of it.

There is a verdict if the 95 % interval of the difference between the best two excludes 0. The interval is wide if the runs of a model disagree, so
that they hide small differences and no large ones. A difference below LEAST nats decides nothing (Kass & Raftery 1995: "not worth more than a bare
mention").
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from bayes_body.results.evidence.candidates import Candidate, Recording
from bayes_body.results.evidence.estimate import Difference, Estimate, difference, estimate
from bayes_body.results.posterior.diagnosis import Thresholds

# Nats: a Bayes factor of e.
LEAST = 1.0
# So many times the particles are advice; beyond, the variance does not fall as for many particles.
MOST = 50


class Comparison(NamedTuple):
    """Models by evidence, the best one first.

    Attributes:
        candidates: the models.
        estimates: the log-evidence of each up to each frame.
        differences: to the best model, likewise; those of the best one are 0.
        recording: what was tracked.
        evidence_sd: largest standard deviation over runs that agree, nats.
    """

    candidates: tuple[Candidate, ...]
    estimates: tuple[Estimate, ...]
    differences: tuple[Difference, ...]
    recording: Recording
    evidence_sd: float = Thresholds().evidence_sd

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.candidates[0].log_evidence.shape[1]

    @property
    def preferred(self) -> str | None:
        """Name of the model that the images prefer; None if they do not say, or if the runs are too few or disagree too much."""
        lead = self.differences[1]
        return self.candidates[0].name if lead.high[-1] < 0 and lead.value[-1] <= -LEAST else None


def compare(candidates: Sequence[Candidate], recording: Recording) -> Comparison:
    """Return the models in the order of their evidence."""
    estimates = [estimate(candidate.log_evidence) for candidate in candidates]
    order = sorted(range(len(candidates)), key=lambda k: -estimates[k].value[-1])
    best = estimates[order[0]]
    zero = np.zeros_like(best.value)
    differences = [Difference(*(zero,) * 4), *(difference(estimates[k], best) for k in order[1:])]
    return Comparison(tuple(candidates[k] for k in order), tuple(estimates[k] for k in order), tuple(differences), recording)


def verdict(comparison: Comparison) -> str:
    """Return what the images say about the best model and the second best, in one sentence."""
    best, second = comparison.candidates[:2]
    lead = comparison.differences[1]
    value, error, low, high = -lead.value[-1], lead.error[-1], -lead.high[-1], -lead.low[-1]
    over = f"over {comparison.frames} frame{'s' * (comparison.frames > 1)}"
    if not np.isfinite(value):
        return f"There is no verdict: no run of `{second.name}` explains every frame, so nothing is known of its evidence."
    if np.isnan(error):
        singles = " and ".join(f"`{candidate.name}`" for candidate in (best, second) if len(candidate.log_evidence) < 2)
        words = f"`{best.name}` is ahead of `{second.name}` by {value:.1f} nats {over}"
        return f"There is no verdict: {words}, but the Monte Carlo error of one run of {singles} is unknown; track two or more runs of each model."
    interval = f"95 % from {_nats(low)} to {_nats(high)}"
    if comparison.preferred:
        return f"`{best.name}` is preferred to `{second.name}` by {_nats(value)} ± {_nats(error)} nats {over} ({interval})."
    doubtful = _disagreeing(comparison, 2)
    if doubtful and low <= 0:
        sds = " and ".join(f"`{comparison.candidates[k].name}` ({_spread(comparison.estimates[k].sd[-1])})" for k in doubtful)
        return (
            f"There is no verdict: the runs of {sds} disagree too much, or are too few, for a difference of {_nats(value)} nats {over} ({interval})."
        )
    return f"The images do not tell `{best.name}` from `{second.name}`: they differ by {_nats(value)} ± {_nats(error)} nats {over} ({interval})."


def remarks(comparison: Comparison) -> list[str]:
    """Return what a reader must know of the figures, one sentence each."""
    lines = []
    for k in _disagreeing(comparison, len(comparison.candidates)):
        candidate, sd = comparison.candidates[k], comparison.estimates[k].sd[-1]
        if np.isinf(sd):
            lost = np.isneginf(candidate.log_evidence).any(axis=1).sum()
            lines.append(
                f"{lost} of {len(candidate.log_evidence)} runs of `{candidate.name}` lost a frame that no particle explains: raise --particles."
            )
            continue
        # The variance of the log-evidence falls with the number of particles.
        factor = np.ceil((sd / comparison.evidence_sd) ** 2)
        more = f"about {factor:.0f} times as many particles would do" if factor <= MOST else "take another kernel, such as tempered"
        limit = f"sd {sd:.1f} nats, limit {comparison.evidence_sd:g}"
        lines.append(f"the runs of `{candidate.name}` disagree ({limit}), most in {_worst_frame(comparison, k)}: {more}.")
    kernels = {candidate.kernel for candidate in comparison.candidates}
    if len(kernels) > 1:
        lines.append(f"the kernels differ ({', '.join(sorted(kernels))}): the errors of both are in the difference.")
    predictions = {candidate.prediction for candidate in comparison.candidates if candidate.prediction}
    if len(predictions) > 1:
        lines.append('with prediction = "gaussian", the evidence is that of a filter that approximates; the other one is exact as particles grow.')
    return lines


def figures(comparison: Comparison) -> dict[str, Any]:
    """Return everything as plain numbers for a file of JSON; what is unknown or infinite is None."""
    rows = []
    for candidate, evidence, lead in zip(comparison.candidates, comparison.estimates, comparison.differences, strict=True):
        rows.append(
            {
                "name": candidate.name,
                "model": candidate.model,
                "kernel": candidate.kernel,
                "folders": [str(folder) for folder in candidate.folders],
                "runs": evidence.runs,
                "log_evidence": _plain(evidence.value[-1]),
                "log_evidence_error": _plain(evidence.error[-1]),
                "log_evidence_sd": _plain(evidence.sd[-1]),
                "log_evidence_by_run": [_plain(total) for total in candidate.log_evidence.sum(axis=1)],
                "per_frame": _plain(evidence.value[-1] / comparison.frames),
                "difference": _plain(lead.value[-1]),
                "difference_error": _plain(lead.error[-1]),
                "difference_interval": [_plain(lead.low[-1]), _plain(lead.high[-1])],
                "difference_by_frame": {name: [_plain(value) for value in values] for name, values in lead._asdict().items()},
            }
        )
    of_recording: Mapping[str, Any] = comparison.recording._asdict() | {"frames": comparison.frames}
    return {
        "recording": dict(of_recording),
        "unit": "nats, up to the likelihood's constant",
        "preferred": comparison.preferred,
        "sentence": verdict(comparison),
        "remarks": remarks(comparison),
        "models": rows,
    }


def _disagreeing(comparison: Comparison, first: int) -> list[int]:
    """Return which of the first models have runs that disagree."""
    return [k for k, evidence in enumerate(comparison.estimates[:first]) if evidence.sd[-1] > comparison.evidence_sd]


def _worst_frame(comparison: Comparison, k: int) -> str:
    spread = comparison.candidates[k].log_evidence.std(axis=0, ddof=1)
    return f"frame {comparison.recording.first_frame + int(np.argmax(spread))}"


def _spread(sd: float) -> str:
    return f"sd {_nats(sd)} nats" if np.isfinite(sd) else "some lost a frame"


def _nats(value: float) -> str:
    """Return a number of nats with the digits that a reader needs."""
    return f"{value:.0f}" if abs(value) >= 20 else f"{value:.1f}"


def _plain(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
