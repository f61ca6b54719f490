"""The models to compare, each with the log-evidence of all its finished runs, and why runs cannot be compared.

A likelihood is a function of the images and the body, known up to a constant that depends on its terms, on their options, and on the frames. So all
runs must be of the same images, with the same likelihood terms and options. The body may differ only if all terms are distributions over data, which
have no unknown constant: then a factor can simulate data. Even then it must have the same markers, because keypoints without a marker are no data.
Priors may differ freely: motion, limits, constraints, unknowns.
"""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import input_error
from bayes_body.model.definition import Definition, TermDefinition, parse_definition
from bayes_body.results.posterior.mixing_sentences import frame_ranges, frames_where
from bayes_body.results.storage.run_changes import NAMED, check_plugins, model_settings, refuse_other_data
from bayes_body.results.storage.run_file import read_record
from bayes_body.results.storage.saved_run import SavedRun, load_run

CONSTANT = "the same likelihood in all runs: evidence is known up to its constant"


class Candidate(NamedTuple):
    """A model, and what its runs say.

    Attributes:
        name: of the model; with the kernel or the folder, if several have the same name.
        model: the definition's name.
        folders: those of its runs.
        kernel: the kernel's name.
        prediction: what the frame before predicts, if the kernel has this option; else empty.
        log_evidence: of each frame given the frames before it, nats, up to the likelihood's constant.
    """

    name: str
    model: str
    folders: tuple[Path, ...]
    kernel: str
    prediction: str
    log_evidence: Float[np.ndarray, "run frame"]


class Recording(NamedTuple):
    """What was tracked: the session's title, the number of the first frame, and frames per second."""

    title: str
    first_frame: int
    fps: float


def candidates_of(folders: Sequence[Path]) -> tuple[list[Candidate], Recording]:
    """Return the models of finished runs, in the order in which they are named, and their recording. Runs of one model count together.

    Args:
        folders: folders of runs.

    Raises:
        InputError: a folder has no finished run, a run has no evidence, there is only one model, or the runs cannot be compared.
    """
    with ExitStack() as stack:
        runs = [stack.enter_context(load_run(folder)) for folder in folders]
        records = [read_record(folder) for folder in folders]
        _check_comparable(runs, records)
        evidences = [_log_evidence(run) for run in runs]
        groups: dict[str, list[int]] = {}
        for number, record in enumerate(records):
            groups.setdefault(model_settings(record), []).append(number)
        if len(groups) < 2:
            problem, remedy = "only one model and kernel", "name runs of another model too, or compare its runs with `bayes-body combine`"
            raise input_error("the runs", problem, "runs of two or more models", remedy)
        candidates = []
        for members in groups.values():
            _check_seeds([runs[k] for k in members])
            first, log_evidence = runs[members[0]], np.concatenate([evidences[k] for k in members])
            model, kernel = Path(str(first.settings["model"])).stem, str(first.kernel["kind"])
            prediction = str(first.kernel.get("prediction", ""))
            candidates.append(Candidate(model, model, tuple(folders[k] for k in members), kernel, prediction, log_evidence))
        return _with_names(candidates), Recording(runs[0].session.title, runs[0].first_frame, runs[0].fps)


def check_constraints(folders: Sequence[Path]) -> None:
    """Check that the evidence of a window means the same in all runs: it counts constraints as seen.

    Raises:
        InputError: the constraints differ, or a prior has potentials, whose constant is unknown.
    """
    first: Definition | None = None
    for folder in folders:
        with load_run(folder) as run:
            definition = _definition(run)
            potentials = [factor.name for factor in run.model.factors if factor.side == "prior"]
            if potentials:
                problem = f"its prior has the potential '{potentials[0]}', whose constant is unknown"
                raise input_error(folder, problem, "a prior that is a distribution", "leave out --window")
            first = definition if first is None else first
            differences = _differences(_options("constraint", definition.constraints), _options("constraint", first.constraints))
            if differences:
                expected, remedy = "the same constraints in all runs: the window counts them as seen", "leave out --window"
                raise input_error(f"{folder}: cannot be compared with {folders[0]}", differences, expected, remedy)


def _log_evidence(run: SavedRun) -> Float[np.ndarray, "run frame"]:
    """Return the log-evidence of the frames of a run.

    Raises:
        InputError: it has none, or one of a frame is not that of the frame given the frames before it.
    """
    remedy = "track again with a kernel that samples the posterior, such as --kernel tempered"
    if run.mode_seeker:
        problem = f"the kernel '{run.kernel['kind']}' seeks modes and estimates no evidence"
        raise input_error(run.folder, problem, "runs that sample the posterior", remedy)
    values = np.asarray(run.tree["filter"]["log_evidence"], float)
    missing = np.isnan(values).any(axis=0)
    if missing.any():
        problem = f"no evidence in {frames_where(missing, run.first_frame)}"
        raise input_error(run.folder, problem, "an evidence of every frame", remedy)
    restarted = run.summary.get("frames_restarted") or []
    if restarted:
        problem = f"started anew in {frame_ranges(restarted)}, from poses that were found in that frame's images"
        raise input_error(run.folder, problem, "runs in which every frame follows from the frames before it", "track again with --no-recover")
    return values


def _check_comparable(runs: Sequence[SavedRun], records: Sequence[Mapping[str, Any]]) -> None:
    """Check that the evidences of the runs are those of the same images, up to the same constant.

    Raises:
        InputError: they are not.
    """
    folders = [run.folder for run in runs]
    for run in runs:
        check_plugins(run.folder, run.plugins)
    refuse_other_data(folders, records)
    first, definitions = runs[0], [_definition(run) for run in runs]
    for run, definition in zip(runs[1:], definitions[1:], strict=True):
        subject = f"{run.folder}: cannot be compared with {first.folder}"
        if run.frames != first.frames:
            problem = f"{run.frames} frames, and {first.frames} in the first run"
            raise input_error(subject, problem, "the same frames in all runs", "continue the shorter run, or track again with --frames")
        differences = _differences(_likelihoods(definition), _likelihoods(definitions[0]))
        if differences:
            remedy = "copy the [[likelihood]] tables of one model into a copy of the other's file, and track again"
            raise input_error(subject, differences, CONSTANT, remedy)
        if definition.body != definitions[0].body or definition.placement != definitions[0].placement:
            _check_body(run, subject, definition, definitions[0])


def _definition(run: SavedRun) -> Definition:
    name, subject = Path(str(run.settings["model"])).stem, f"{run.folder}: the definition's text"
    return parse_definition(name, run.texts["text"], run.texts.get("body_text"), subject)


def _likelihoods(definition: Definition) -> dict[str, Any]:
    """Return every option of the likelihood terms, with its default if the file does not give it, by names that a user knows."""
    options = _options("likelihood", definition.likelihoods)
    for number, term in enumerate(definition.likelihoods, 1):
        options |= {f"likelihood #{number}: observation.{name}": value for name, value in term.observation.model_dump().items()}
    return options


def _options(room: str, terms: Sequence[TermDefinition]) -> dict[str, Any]:
    """Return the kind and all options of each term."""
    options: dict[str, Any] = {}
    for number, term in enumerate(terms, 1):
        options[f"{room} #{number}: kind"] = term.kind
        options |= {f"{room} #{number}: {name}": value for name, value in term.options.model_dump().items()}
    return options


def _differences(options: Mapping[str, Any], first: Mapping[str, Any]) -> str:
    """Return in words what differs; empty if nothing does. Of terms of other kinds, only the kinds are named."""
    changed = [name for name in dict.fromkeys([*first, *options]) if options.get(name) != first.get(name)]
    kinds = [name for name in changed if name.endswith(": kind")]
    words = [f"{name} is {options.get(name, 'not there')}, and {first.get(name, 'not there')} in the first run" for name in kinds or changed]
    more = [f"{len(words) - NAMED} more differ"] if len(words) > NAMED else []
    return "; ".join([*words[:NAMED], *more])


def _check_body(run: SavedRun, subject: str, definition: Definition, first: Definition) -> None:
    """Check that the likelihood's data and its constant do not depend on the body.

    Raises:
        InputError: they may.
    """
    markers, first_markers = set(definition.body.markers), set(first.body.markers)
    if markers != first_markers:
        names = ", ".join(sorted(markers ^ first_markers))
        problem = f"the bodies {definition.body_name} and {first.body_name} do not have the same markers ({names})"
        raise input_error(subject, problem, "bodies that read the same keypoints", "take one body in both models")
    unnormalised = [factor.name for factor in run.model.factors if factor.side == "likelihood" and factor.simulate is None]
    if unnormalised:
        problem = f"the body is {definition.body_name}, and {first.body_name} in the first run, and '{unnormalised[0]}' is no distribution over data"
        remedy = "take one body in both models, or a likelihood that is a distribution over data"
        raise input_error(subject, problem, "one body, or a likelihood whose constant does not depend on it", remedy)


def _check_seeds(runs: Sequence[SavedRun]) -> None:
    """Check that the runs of one model are independent.

    Raises:
        InputError: two have the same seed.
    """
    seeds: dict[int, Path] = {}
    for run in runs:
        for seed in run.chains.get("seeds") or [run.settings.get("seed", 0)]:
            if seed in seeds:
                expected, remedy = "independent runs: equal seeds give equal draws", "leave one out, or track again with another --seed"
                raise input_error(run.folder, f"has the seed {seed}, as {seeds[seed]}", expected, remedy)
            seeds[seed] = run.folder


def _with_names(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Return the candidates with different names: the model's, with the kernel if needed, or with the folder."""

    def is_repeated(name: str) -> bool:
        return [candidate.name for candidate in candidates].count(name) > 1

    with_kernel = [f"{candidate.model} ({candidate.kernel})" for candidate in candidates]
    named = []
    for candidate, longer in zip(candidates, with_kernel, strict=True):
        longest = f"{candidate.model} ({candidate.folders[0].name})"
        name = candidate.name if not is_repeated(candidate.name) else longer if with_kernel.count(longer) == 1 else longest
        named.append(candidate._replace(name=name))
    names = [candidate.name for candidate in named]
    return [candidate._replace(name=str(candidate.folders[0])) if names.count(candidate.name) > 1 else candidate for candidate in named]
