"""Check a model and a kernel: the experiments, and their results at a look."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from bayes_body.base.progress import Watch, unwatched
from bayes_body.base.registry import find
from bayes_body.base.toml.read import validate
from bayes_body.kernels.markov_moves import MarkovMove
from bayes_body.model.build import Model, build_model
from bayes_body.model.definition import load_definition
from bayes_body.model.plugins.load import load_plugin
from bayes_body.recording.session.read import load_session
from bayes_body.workshop.calibration import invariance, sbc
from bayes_body.workshop.calibration.looks import REPLICATIONS
from bayes_body.workshop.calibration.problem import Problem, check_cases, problem_of
from bayes_body.workshop.calibration.replications import Compute, Experiments, Figures, ReplicationLog, add_replications
from bayes_body.workshop.calibration.scene import model_in_a_room

SBC, INVARIANCE = "sbc", "invariance"
# A move is much cheaper than a filter, so more replications are affordable.
EACH = {SBC: 1, INVARIANCE: 2}


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
    """The replications of a check at a look.

    Attributes:
        names: names of the ranked quantities.
        ranks: figures of the ranks.
        bins: number of bins of the ranks.
        move_names: names of the figures of the Markov move.
        moves: figures of the Markov move; None if the kernel has none.
        looks: number of the look that each test has reached, from 0.
    """

    names: tuple[str, ...]
    ranks: Figures
    bins: int
    move_names: tuple[str, ...] = ()
    moves: Figures | None = None
    looks: Mapping[str, int] = MappingProxyType({SBC: 0, INVARIANCE: 0})


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
    by_name: dict[str, Any] = {SBC: sbc.replicate(problem, kernel, options.particles, frames, bins)}
    if move is not None:
        by_name[INVARIANCE] = invariance.replicate(problem, move)
    return Experiments(seed, by_name, problem)


def markov_move(kind: str, options: Any) -> MarkovMove | None:
    """Return the Markov move that a kernel declares, or None.

    Args:
        kind: the kernel's name.
        options: the kernel's options, in its schema.
    """
    declared = find("kernel", kind).markov_move
    return None if declared is None else declared(options)


def has_move(plan: Plan) -> bool:
    """Whether the plan's kernel has a Markov move that leaves the posterior invariant."""
    return markov_move(plan.kernel, validate(find("kernel", plan.kernel).options, plan.options, plan.kernel)) is not None


def findings(
    problem: Problem, compute: Compute, looks: Mapping[str, int], replications: int, bins: int, log: ReplicationLog, watch: Watch = unwatched
) -> Findings:
    """The replications that the tests need at their looks. Those in `log` are not computed again.

    Args:
        problem: the problem of the experiments.
        compute: computes their blocks.
        looks: number of the look of each test, from 0.
        replications: number of replications of the ranks at the first look.
        bins: number of bins of the ranks.
        log: existing replications, to which new ones are added.
        watch: shows the progress.

    Raises:
        InputError: nothing can be simulated from the model.
    """
    by_test = add_replications(compute, {name: replications * EACH[name] * REPLICATIONS[look] for name, look in looks.items()}, log, watch)
    for figures in by_test.values():
        check_cases(figures["refused"], figures["unbounded"])
    names = (*problem.quantities.names, sbc.LOG_LIKELIHOOD)
    return Findings(names, by_test[SBC], bins, invariance.figure_names(problem), by_test.get(INVARIANCE), dict(looks))
