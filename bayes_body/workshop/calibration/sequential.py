"""Run a check until its verdict is clear, by looking at more and more replications (workshop/calibration/looks.py).

A few replications with increasing numbers of particles find how many particles a kernel needs for nearly independent draws.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from bayes_body.base.progress import Watch, unwatched
from bayes_body.model.plugins.load import where_of
from bayes_body.workshop.calibration import sbc
from bayes_body.workshop.calibration.check import INVARIANCE, SBC, Findings, Plan, experiments_of, findings, has_move, model_of
from bayes_body.workshop.calibration.problem import Problem, check_cases, problem_of
from bayes_body.workshop.calibration.replications import Experiments, ReplicationLog, computing, run_replications
from bayes_body.workshop.calibration.scene import check_effective
from bayes_body.workshop.calibration.verdict import Verdict, verdict

type Show = Callable[[str], None]


def run_check(
    plan: Plan, replications: int, jobs: int = 0, log: ReplicationLog | None = None, watch: Watch = unwatched, show: Show = lambda line: None
) -> tuple[Findings, Verdict]:
    """All replications of a plan, and its verdict.

    Args:
        plan: what is checked.
        replications: number of replications of the ranks at the first look.
        jobs: number of processes; 0 computes in this one.
        log: existing replications, to which new ones are added.
        watch: shows the progress.
        show: receives a line before each further look.

    Raises:
        InputError: nothing can be simulated from the model.
    """
    problem = problem_of(model_of(plan), plan.wandering)
    return decide(problem, partial(experiments_of, plan), has_move(plan), replications, plan.bins, jobs, log, watch, show)


def decide(
    problem: Problem,
    make: Callable[[], Experiments],
    has_move: bool,
    replications: int,
    bins: int,
    jobs: int = 0,
    log: ReplicationLog | None = None,
    watch: Watch = unwatched,
    show: Show = lambda line: None,
) -> tuple[Findings, Verdict]:
    """Like `run_check`, for any problem; `make` builds its experiments, with ranks in `bins` bins."""
    looks = dict.fromkeys([SBC, INVARIANCE] if has_move else [SBC], 0)
    log = ReplicationLog() if log is None else log
    with computing(make, jobs) as compute:
        while True:
            look_findings = findings(problem, compute, looks, replications, bins, log, watch)
            decision = verdict(look_findings)
            if not decision.close:
                return look_findings, decision
            for test, sentence in decision.close.items():
                show(sentence)
                looks[test] += 1


# Replications of a pilot, and the factor by which its worst effective size must exceed the required one.
REPLICATIONS, MARGIN = 20, 1.2
MOST_PARTICLES = 2**16
# The replications of the check itself use other keys.
OTHER_SEED = 2**31


def enough_particles(plan: Plan, jobs: int, show: Callable[[str], None]) -> Plan:
    """The plan with the number of particles doubled until they suffice, up to `MOST_PARTICLES`.

    Args:
        plan: its options give the initial number.
        jobs: number of processes.
        show: receives a line for each number that is tried.

    Raises:
        InputError: nothing can be simulated from the model.
    """
    needed = MARGIN * sbc.DRAWS_A_BIN * plan.bins
    while True:
        particles = plan.options["particles"]
        make = partial(experiments_of, replace(plan, seed=(plan.seed + OTHER_SEED) % 2**32))
        figures = run_replications(make, {SBC: REPLICATIONS}, jobs)[SBC]
        check_cases(figures["refused"], figures["unbounded"])
        check_effective(where_of("kernel", plan.kernel), figures["ess"])
        ess = float(figures["ess"].min())
        show(f"pilot: {particles} particles, {ess:.0f} effective at worst ({needed:.0f} wanted).")
        if ess >= needed or particles >= MOST_PARTICLES:
            return plan
        # The effective size grows approximately with the number of particles, except for a mode seeker.
        plan = more_particles(plan, int(np.clip(np.ceil(np.log2(needed / max(ess, 1.0))), 1, 3)))


def more_particles(plan: Plan, doublings: int = 1) -> Plan:
    """The plan with the number of particles doubled, up to `MOST_PARTICLES`."""
    return replace(plan, options={**plan.options, "particles": min(plan.options["particles"] * 2**doublings, MOST_PARTICLES)})
