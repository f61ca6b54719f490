"""Convert the figures of a check to a verdict and sentences: ranks and bands of each quantity, coverage, the Markov move, effective sizes."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from bayes_body.calibration import bands, invariance, sbc
from bayes_body.calibration.check import Findings
from bayes_body.calibration.coverage import WIDTHS, coverage

FAMILY = 0.95
# The fraction of replications that may have too few effective particles; the fraction of states that a move must change to make its test informative.
MOST_SHORT, LEAST_MOVED = 0.05, 0.1
ESS_NAMES = ("weights", "distinct", "ancestors")


class Verdict(NamedTuple):
    """Whether the kernel passed, sentences for a reader, and the figures behind them (for JSON)."""

    passed: bool
    sentences: tuple[str, ...]
    figures: dict[str, Any]


def verdict(findings: Findings, bins: int, no_move: str = "") -> Verdict:
    """The verdict of a check.

    Args:
        findings: the replications' figures.
        bins: number of bins of the ranks.
        no_move: the sentence for a kernel without a Markov move.
    """
    (ranked, ranks_said, ranks), (enough, ess_said, ess) = _ranks(findings, bins), _effective(findings, bins)
    moved, move_said, moves = (True, no_move, None) if findings.moves is None else _moves(findings)
    lost = float(np.mean(findings.ranks["lost"]))
    said = [ranks_said, ess_said, move_said, f"{lost:.1%} of the replications lost a frame." if lost else ""]
    said.append("PASS." if ranked and enough and moved else "FAIL." if not (ranked and moved) else "UNDECIDED, which counts as not passed.")
    figures = {"ranks": ranks, "effective": ess, "lost_share": lost, "moves": moves}
    return Verdict(ranked and enough and moved, tuple(sentence for sentence in said if sentence), figures)


def ranked_quantities(findings: Findings) -> NDArray[np.intp]:
    """Indices of the quantities that vary. The ranks of a constant quantity are meaningless."""
    return np.flatnonzero(np.ptp(findings.ranks["truth"].astype(float), axis=0) > 0)


def _ranks(findings: Findings, bins: int) -> tuple[bool, str, dict[str, Any]]:
    places, count = ranked_quantities(findings), len(findings.ranks["ranks"])
    counts = bands.rank_counts(findings.ranks["ranks"][:, places], bins)
    p = bands.p_values(counts)
    rejected = bands.holm(p, FAMILY) > 0
    names = [findings.names[place] for place in places]
    limit = (1 - FAMILY) / len(names)
    quantities = {
        name: {"histogram": counted.tolist(), "p_value": float(value), "inside": bool(value > limit), "coverage": _coverage(findings, int(place))}
        for name, place, counted, value in zip(names, places, counts, p, strict=True)
    }
    worst = int(np.argmin(p))
    if rejected.any():
        outside = [f"'{names[k]}' ({_shape(counts[k])}, p = {p[k]:.1g})" for k in np.argsort(p)[:3]]
        said = (
            f"ranks: {np.sum(p <= limit)} of {len(names)} quantities lie outside their bands ({FAMILY:.0%} for all together), {count} replications; "
            f"worst {', '.join(outside[: int(np.sum(p <= limit))])}."
        )
    else:
        said = (
            f"ranks: all {len(names)} quantities lie inside their bands ({FAMILY:.0%} for all together), {count} replications; the smallest p is "
            f"{p[worst]:.2g}, for '{names[worst]}'; the limit is {limit:.2g}."
        )
    return not rejected.any(), said, {"replications": count, "bins": bins, "limit": limit, "quantities": quantities}


def _coverage(findings: Findings, place: int) -> dict[str, Any] | None:
    """The coverage of a quantity; None for the log-likelihood, which has no levels."""
    levels = findings.ranks["levels"]
    return {f"{width:.0%}": coverage(levels[:, place], width)._asdict() for width in WIDTHS} if place < levels.shape[1] else None


def _shape(counts: NDArray[np.integer]) -> str:
    """The meaning of uneven ranks, from their mean or their spread, whichever differs more from a uniform distribution's."""
    total, bins = counts.sum(), len(counts)
    level = (np.arange(bins) + 0.5) / bins
    mean = counts @ level / total - 0.5
    spread = counts @ (level - 0.5) ** 2 / total - 1 / 12
    # In standard deviations under uniform ranks.
    mean, spread = mean * np.sqrt(12 * total), spread * np.sqrt(180 * total)
    if abs(mean) > abs(spread):
        return "the posterior lies too low" if mean > 0 else "the posterior lies too high"
    return "the posterior is too narrow" if spread > 0 else "the posterior is too wide"


def _effective(findings: Findings, bins: int) -> tuple[bool, str, dict[str, Any]]:
    needed, ess = sbc.DRAWS_A_BIN * bins, findings.ranks["ess"].astype(float)
    least = ess.min(axis=1)
    short = float(np.mean(least < needed))
    figures: dict[str, Any] = {"needed": needed, "short_share": short}
    for name, column in zip(ESS_NAMES, ess.T, strict=True):
        # A single frame has no ancestors to distinguish.
        figures[name] = {"median": float(np.median(column)), "least": float(column.min())} if np.isfinite(column).all() else None
    said = f"particles: {np.median(least):.0f} effective (median), {least.min():.0f} (least), {needed} wanted for {bins} bins"
    if short:
        said += f"; {short:.1%} of the replications have too few: raise --particles, or lower --bins"
    return short <= MOST_SHORT, f"{said}.", figures


def _moves(findings: Findings) -> tuple[bool, str, dict[str, Any]]:
    assert findings.moves is not None
    after, other = (np.asarray(findings.moves[name], float) for name in ("after", "other"))
    places = np.flatnonzero(np.ptp(other, axis=0) > 0)
    p, moved = invariance.p_values(after[:, places], other[:, places]), float(np.mean(findings.moves["moved"]))
    rejected = bands.holm(p, FAMILY) > 0
    names = [findings.move_names[place] for place in places]
    worst, limit = int(np.argmin(p)), (1 - FAMILY) / len(names)
    figures = {"replications": len(after), "moved_share": moved, "limit": limit, "p_values": dict(zip(names, map(float, p), strict=True))}
    said = f"Markov move: the smallest p of {len(names)} figures is {p[worst]:.2g}, for '{names[worst]}'; the limit is {limit:.2g}"
    said += ": it does not leave the posterior invariant" if rejected.any() else ": it leaves the posterior invariant"
    if moved < LEAST_MOVED:
        said += f"; but only {moved:.1%} of the states moved, so this test is not informative"
    return not rejected.any(), f"{said}.", figures


def curve(counts: NDArray[np.integer]) -> Float[np.ndarray, " point"]:
    """The empirical distribution function of ranks at k / bins."""
    return np.cumsum(counts)[:-1] / counts.sum()
