"""Run a check until its verdict is clear: looks at more and more replications (workshop/calibration/looks.py)."""

from collections.abc import Callable
from functools import partial

from bayes_body.base.progress import Watch, unwatched
from bayes_body.workshop.calibration.check import INVARIANCE, SBC, Findings, Plan, experiments_of, findings, has_move, model_of
from bayes_body.workshop.calibration.problem import Problem, problem_of
from bayes_body.workshop.calibration.replication_log import ReplicationLog
from bayes_body.workshop.calibration.replications import Experiments, computing
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
    kept: ReplicationLog | None = None,
    watch: Watch = unwatched,
    show: Show = lambda line: None,
) -> tuple[Findings, Verdict]:
    """Like `run_check`, for any problem; `make` builds its experiments, with ranks in `bins` bins."""
    looks = dict.fromkeys([SBC, INVARIANCE] if has_move else [SBC], 0)
    kept = ReplicationLog() if kept is None else kept
    with computing(make, jobs) as compute:
        while True:
            look_findings = findings(problem, compute, looks, replications, bins, kept, watch)
            decision = verdict(look_findings)
            if not decision.close:
                return look_findings, decision
            for test, sentence in decision.close.items():
                show(sentence)
                looks[test] += 1
