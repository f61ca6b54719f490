"""A check from its plan to its verdict: the number of particles, all replications, figures as JSON, a picture, and sentences."""

import json
import time
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from bayes_body.base.files.atomic import write_text
from bayes_body.base.progress import watched
from bayes_body.base.registry import find
from bayes_body.base.toml.read import validate
from bayes_body.model.definition import load_definition
from bayes_body.workshop.calibration.check import Findings, Plan, model_of
from bayes_body.workshop.calibration.picture import draw_ranks, ranks_file, save_ranks
from bayes_body.workshop.calibration.reference import check_reference
from bayes_body.workshop.calibration.replications import SUFFIX, ReplicationLog, settings_of
from bayes_body.workshop.calibration.scene import probe
from bayes_body.workshop.calibration.sequential import Show, enough_particles, more_particles, run_check
from bayes_body.workshop.calibration.verdict import Verdict

# Packages whose version may affect the figures.
COMPUTING = ("bayes-body", "jax", "jaxlib", "numpyro", "blackjax")


def run_and_report(plan: Plan, pilot: bool, replications: int, jobs: int, json_file: Path | None, plot: Path | None, show: Show, bar: bool) -> bool:
    """Check, write the results and report them; returns whether the kernel passed.

    Args:
        plan: what is checked.
        pilot: whether a pilot determines the number of particles; otherwise the plan's is used.
        replications: number of truths to draw for the first look.
        jobs: number of processes.
        json_file: file for the figures; the ranks are written beside it (workshop/calibration/picture.py).
        plot: file for the picture.
        show: receives lines for the user.
        bar: whether to show the progress on standard error.

    Raises:
        InputError: nothing can be checked, or a file cannot be written.
    """
    started, model = time.perf_counter(), model_of(plan)
    term = find("kernel", plan.kernel)
    if term.note:
        show(f"{plan.kernel}: {term.note}")
    if plan.plugins:
        probe(model, term.build(options=validate(term.options, plan.options, plan.kernel)))
    if not_generative := [f.name for f in model.factors if f.side == "likelihood" and f.simulate is None]:
        result, extra = check_reference(plan, model, not_generative, show), {}
    else:
        partial_file = None if json_file is None else json_file.with_name(json_file.name + SUFFIX)
        plan = _with_particles(plan, partial_file, jobs, show) if pilot else plan
        plan, findings, result = _checked(plan, pilot, replications, jobs, partial_file, show, bar)
        if plot is not None:
            _draw(findings, plan, plot, result)
        if json_file is not None:
            save_ranks(findings, ranks_file(json_file))
        extra = {"replications": replications}
    for sentence in result.sentences:
        show(sentence)
    if json_file is not None:
        seconds = time.perf_counter() - started
        figures = _settings(plan) | extra | result.figures | {"seconds": seconds, "passed": result.passed, "verdict": " ".join(result.sentences)}
        write_text(json_file, json.dumps(figures, indent=2) + "\n")
        json_file.with_name(json_file.name + SUFFIX).unlink(missing_ok=True)
    return result.passed


def _checked(
    plan: Plan, pilot: bool, replications: int, jobs: int, partial_file: Path | None, show: Show, bar: bool
) -> tuple[Plan, Findings, Verdict]:
    """The check. Where the pilot's number of particles turns out too small, it starts again with twice as many.

    This causes no false alarms: effective sizes depend on the data, and given the data the ranks of a correct kernel are uniform.
    """
    while True:
        blocks = ReplicationLog(partial_file, _settings(plan))
        if len(blocks):
            show(f"{partial_file}: continuing with {len(blocks)} blocks of replications")
        findings, result = run_check(plan, replications, jobs, blocks, watched("blocks of replications", bar), show)
        more = more_particles(plan)
        if result.ess_suffices or not pilot or more == plan:
            return plan, findings, result
        short, particles = result.figures["effective"]["short_share"], plan.options["particles"]
        show(f"particles: {particles} are too few for {short:.1%} of the replications: once more with {more.options['particles']}.")
        blocks.remove()
        plan = more


def _settings(plan: Plan) -> dict[str, Any]:
    return asdict(plan) | {"versions": {name: version(name) for name in COMPUTING}, "definition": _text(plan)}


def _text(plan: Plan) -> str:
    """The text of the definition: a changed file is a different model."""
    definition = load_definition(plan.model)
    return f"{definition.text}\n{definition.body_text}"


def _with_particles(plan: Plan, partial_file: Path | None, jobs: int, show: Show) -> Plan:
    """The plan with enough particles: the number used by existing replications, or the pilot's result."""
    partial_settings = None if partial_file is None else settings_of(partial_file)
    if partial_settings is not None:
        return replace(plan, options={**plan.options, "particles": partial_settings["options"]["particles"]})
    return enough_particles(plan, jobs, show)


def _draw(findings: Findings, plan: Plan, plot: Path, result: Verdict) -> None:
    outcome = "passed" if result.passed else "not passed"
    draw_ranks(findings, plot, f"{plan.kernel} on {Path(plan.model).stem}: {outcome}")
