"""Convert the figures of a check to a verdict and sentences: ranks of each quantity, coverage, the Markov move, effective sizes.

Coverage is how often the posterior's weighted, equal-tailed intervals contain the truth. Each coverage has a binomial interval.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.stats import binomtest

from bayes_body.workshop.calibration import bands, invariance, sbc
from bayes_body.workshop.calibration.check import INVARIANCE, SBC, Findings
from bayes_body.workshop.calibration.looks import FALSE_ALARM, REPLICATIONS, Limits, fails, is_close, limits

WIDTHS = (0.5, 0.9)
CONFIDENCE = 0.95


class Coverage(NamedTuple):
    """The fraction of truths inside, and a binomial interval for its probability (Wilson 1927)."""

    share: float
    low: float
    high: float


def coverage(levels: Float[np.ndarray, " replication"], width: float) -> Coverage:
    """The coverage of one quantity.

    Args:
        levels: posterior probability below the truth, by replication.
        width: posterior probability of the interval, such as 0.9.
    """
    inside = int(np.sum(np.abs(levels - 0.5) <= width / 2))
    interval = binomtest(inside, len(levels)).proportion_ci(CONFIDENCE, method="wilson")
    return Coverage(inside / len(levels), float(interval.low), float(interval.high))


# The fraction of replications that may have too few effective particles; the fraction of states that a move must change to make its test informative.
MOST_SHORT, LEAST_MOVED = 0.05, 0.1
ESS_NAMES = ("weights", "distinct", "ancestors")
NO_MOVE = "Markov move: the kernel has none that leaves the posterior invariant, so exact invariance is not tested."
PROMISE = f"A correct kernel fails in at most {FALSE_ALARM:.0%} of all checks."


class Verdict(NamedTuple):
    """The verdict at a look. It is not final if a test is close.

    Attributes:
        passed: whether the kernel passed.
        sentences: sentences for a reader.
        figures: the figures behind them, for JSON.
        ess_suffices: whether nearly all replications have enough effective particles.
        close: for each test that needs more replications, a sentence that says so.
    """

    passed: bool
    sentences: tuple[str, ...]
    figures: dict[str, Any]
    ess_suffices: bool = True
    close: Mapping[str, str] = MappingProxyType({})


class _Test(NamedTuple):
    """The p-values of a test's quantities at its look, with their limits."""

    names: tuple[str, ...]
    p: Float[np.ndarray, " quantity"]
    limit: Limits
    look: int
    replications: int

    @property
    def fails(self) -> bool:
        return fails(self.p, self.limit)

    @property
    def worst(self) -> str:
        return f"the smallest p of {len(self.p)} is {self.p.min():.2g}, for '{self.names[int(np.argmin(self.p))]}'"

    def figures(self) -> dict[str, Any]:
        return {"replications": self.replications, "look": self.look + 1, "fails_at": self.limit.fails, "passes_above": self.limit.passes}


def verdict(findings: Findings) -> Verdict:
    """The verdict of a check at the look that its tests have reached."""
    (ranked, ranks_said, ranks), (ess_suffices, ess_said, ess) = _ranks(findings), _effective(findings)
    moved, move_said, moves = (None, NO_MOVE, None) if findings.moves is None else _moves(findings)
    failed = ranked.fails or (moved is not None and moved.fails)
    lost = float(np.mean(findings.ranks["lost"]))
    said = [ranks_said, ess_said, move_said, f"{lost:.1%} of the replications lost a frame." if lost else ""]
    said.append(f"FAIL. {PROMISE}" if failed else f"PASS. {PROMISE}" if ess_suffices else "UNDECIDED, which counts as not passed.")
    figures = {"false_alarm": FALSE_ALARM, "ranks": ranks, "effective": ess, "lost_share": lost, "moves": moves}
    # More replications do not help a check that has failed, or has too few particles.
    tests = {} if failed or not ess_suffices else {SBC: ("ranks", ranked)} | ({} if moved is None else {INVARIANCE: ("Markov move", moved)})
    close = {key: _close(name, test) for key, (name, test) in tests.items() if is_close(test.p, test.limit)}
    return Verdict(ess_suffices and not failed, tuple(sentence for sentence in said if sentence), figures, ess_suffices, close)


def ranked_quantities(findings: Findings) -> NDArray[np.intp]:
    """Indices of the quantities that vary. The ranks of a constant quantity are meaningless."""
    return np.flatnonzero(np.ptp(findings.ranks["truth"].astype(float), axis=0) > 0)


def rank_limits(findings: Findings) -> Limits:
    """The limits of the p-value of each ranked quantity."""
    return limits(findings.looks[SBC], 1 if findings.moves is None else 2, len(ranked_quantities(findings)))


def _close(name: str, test: _Test) -> str:
    more = test.replications * REPLICATIONS[test.look + 1] // REPLICATIONS[test.look] - test.replications
    return f"{name}: close, {test.worst}, between {test.limit.fails:.2g} (fails) and {test.limit.passes:.2g} (passes): {more} more replications."


def _ranks(findings: Findings) -> tuple[_Test, str, dict[str, Any]]:
    places, count = ranked_quantities(findings), len(findings.ranks["ranks"])
    counts = bands.rank_counts(findings.ranks["ranks"][:, places], findings.bins)
    p, names = bands.p_values(counts), tuple(findings.names[place] for place in places)
    test = _Test(names, p, rank_limits(findings), findings.looks[SBC], count)
    quantities = {
        name: {"histogram": counted.tolist(), "p_value": float(value), "coverage": _coverage(findings, int(place))}
        for name, place, counted, value in zip(names, places, counts, p, strict=True)
    }
    if test.fails:
        outside = [f"'{names[k]}' ({_shape(counts[k])}, p = {p[k]:.1g})" for k in np.argsort(p) if p[k] <= test.limit.fails]
        said = f"ranks: {len(outside)} of {len(names)} quantities are not uniform, {count} replications; worst {', '.join(outside[:3])}; "
    else:
        said = f"ranks: uniform, {count} replications; {test.worst}; "
    return test, f"{said}{_limit_said(test)}.", test.figures() | {"bins": findings.bins, "quantities": quantities}


def _limit_said(test: _Test) -> str:
    return f"a kernel fails at {test.limit.fails:.2g} or less"


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


def _effective(findings: Findings) -> tuple[bool, str, dict[str, Any]]:
    """The effective sizes. Whether they are enough is decided at the first look, so that it does not depend on the ranks."""
    bins, ess = findings.bins, findings.ranks["ess"].astype(float)
    needed, least = sbc.DRAWS_A_BIN * bins, ess.min(axis=1)
    short, first = float(np.mean(least < needed)), least[: len(least) // REPLICATIONS[findings.looks[SBC]]]
    figures: dict[str, Any] = {"needed": needed, "short_share": short}
    for name, column in zip(ESS_NAMES, ess.T, strict=True):
        # A single frame has no ancestors to distinguish.
        figures[name] = {"median": float(np.median(column)), "least": float(column.min())} if np.isfinite(column).all() else None
    said = f"particles: {np.median(least):.0f} effective (median), {least.min():.0f} (least), {needed} wanted for {bins} bins"
    ess_suffices = float(np.mean(first < needed)) <= MOST_SHORT
    if short:
        said += f"; {short:.1%} of the replications have too few" + ("" if ess_suffices else ": raise --particles, or lower --bins")
    return ess_suffices, f"{said}.", figures


def _moves(findings: Findings) -> tuple[_Test, str, dict[str, Any]]:
    assert findings.moves is not None
    moved_figures, independent = (np.asarray(findings.moves[name], float) for name in ("after", "other"))
    places = np.flatnonzero(np.ptp(independent, axis=0) > 0)
    p, moved = invariance.p_values(moved_figures[:, places], independent[:, places]), float(np.mean(findings.moves["moved"]))
    names, look = tuple(findings.move_names[place] for place in places), findings.looks[INVARIANCE]
    test = _Test(names, p, limits(look, 2, len(p)), look, len(moved_figures))
    said = "it does not leave the posterior invariant" if test.fails else "it leaves the posterior invariant"
    said = f"Markov move: {said}, {len(moved_figures)} replications; {test.worst}; {_limit_said(test)}"
    if moved < LEAST_MOVED:
        said += f"; but only {moved:.1%} of the states moved, so this test is not informative"
    return test, f"{said}.", test.figures() | {"moved_share": moved, "p_values": dict(zip(names, map(float, p), strict=True))}
