"""Check a model and a kernel: the experiments, how they run, and their results."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from bayes_body.calibration import invariance, sbc
from bayes_body.calibration.markov_moves import markov_move
from bayes_body.calibration.problem import Problem, check_cases, problem_of
from bayes_body.calibration.replication_log import ReplicationLog
from bayes_body.calibration.replications import Experiments, Figures, run_replications
from bayes_body.calibration.scene import model_in_a_room
from bayes_body.model.build import Model, build_model
from bayes_body.model.definition import load_definition
from bayes_body.plugins.load import load_plugin
from bayes_body.registry import find
from bayes_body.session.read import load_session
from bayes_body.toml.read import validate
from bayes_body.view.progress import Watch, unwatched

SBC, INVARIANCE = "sbc", "invariance"
# A move is much cheaper than a filter, so more replications are affordable.
MOVES_A_REPLICATION = 2


@dataclass(frozen=True)
class Plan:
    """What is checked: everything that affects the figures of a replication.

    Attributes:
        model: name or path of a definition.
        kernel: name of a kernel.
        options: all its options, including particles.
        session: folder of a session that supplies cameras, subject and first pose; None: a room with four cameras.
        rig: file with other cameras for that room.
        frames: number of frames that a filter processes.
        bins: number of bins of the ranks.
        wandering: number of steps of the motion prior that separate the first states of the replications.
        seed: the seed of everything random.
        plugins: files with the user's own terms, which each process loads.
    """

    model: str
    kernel: str
    options: Mapping[str, Any] = field(default_factory=dict)
    session: str | None = None
    rig: str | None = None
    frames: int = 2
    bins: int = 20
    wandering: int = 10
    seed: int = 0
    plugins: tuple[str, ...] = ()


class Findings(NamedTuple):
    """The results of the experiments: names and figures of the ranks, and of the Markov move if the kernel has one."""

    names: tuple[str, ...]
    ranks: Figures
    move_names: tuple[str, ...]
    moves: Figures | None


def model_of(plan: Plan) -> Model:
    """The plan's model, with its session or in a room.

    Raises:
        InputError: the definition, the session or the rig cannot be used.
    """
    for plugin in plan.plugins:
        load_plugin(plugin)
    definition = load_definition(plan.model)
    if plan.session is not None:
        return build_model(definition, load_session(Path(plan.session)))
    return model_in_a_room(definition, None if plan.rig is None else Path(plan.rig))


def experiments_of(plan: Plan) -> Experiments:
    """Build the experiments; called in each process."""
    problem = problem_of(model_of(plan), plan.wandering)
    term = find("kernel", plan.kernel)
    return experiments(problem, plan.kernel, validate(term.options, plan.options, plan.kernel), plan.frames, plan.bins, plan.seed)


def experiments(problem: Problem, kind: str, options: Any, frames: int = 2, bins: int = 20, seed: int = 0) -> Experiments:
    """The experiments for a kernel and any problem, including a user's own.

    Args:
        problem: the model and what is ranked.
        kind: the kernel's name.
        options: the kernel's options, in its schema.
        frames: number of frames that a filter processes.
        bins: number of bins of the ranks.
        seed: the seed of everything random.
    """
    kernel, move = find("kernel", kind).build(options=options), markov_move(kind, options)
    found: dict[str, Any] = {SBC: sbc.replicate(problem, kernel, options.particles, frames, bins)}
    if move is not None:
        found[INVARIANCE] = invariance.replicate(problem, move)
    return Experiments(seed, found, problem)


def run_check(plan: Plan, replications: int, jobs: int = 0, kept: ReplicationLog | None = None, watch: Watch = unwatched) -> Findings:
    """Run all replications of a plan.

    Args:
        plan: what is checked.
        replications: number of replications for the ranks.
        jobs: number of processes; 0 computes in this one.
        kept: existing replications, to which new ones are added.
        watch: shows the progress.

    Raises:
        InputError: nothing can be simulated from the model.
    """
    problem = problem_of(model_of(plan), plan.wandering)
    has_move = markov_move(plan.kernel, validate(find("kernel", plan.kernel).options, plan.options, plan.kernel)) is not None
    return findings(problem, partial(experiments_of, plan), has_move, replications, jobs, kept, watch)


def findings(
    problem: Problem,
    make: Callable[[], Experiments],
    has_move: bool,
    replications: int,
    jobs: int = 0,
    kept: ReplicationLog | None = None,
    watch: Watch = unwatched,
) -> Findings:
    """Like `run_check`, for any problem; `make` builds its experiments."""
    counts = {SBC: replications} | ({INVARIANCE: MOVES_A_REPLICATION * replications} if has_move else {})
    found = run_replications(make, counts, jobs, kept, watch)
    for figures in found.values():
        check_cases(figures["refused"], figures["unbounded"])
    names = (*problem.quantities.names, sbc.LOG_LIKELIHOOD)
    return Findings(names, found[SBC], invariance.figure_names(problem), found.get(INVARIANCE))
