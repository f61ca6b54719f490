"""Every kernel on every definition for which the view exists, and one sentence for each for which it does not.

Both come from where they are registered: a kernel or a definition that is added is in the matrix without another word.
"""

import hashlib
import traceback
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from bayes_body.compare.scenes import Scene, Scenes
from bayes_body.errors import InputError
from bayes_body.metrics import accuracy_figures, draws_against_truth, log_evidence
from bayes_body.model.definition import Definition, definition_names, load_definition
from bayes_body.model.kernel_options import kernel_options
from bayes_body.plugins.load import plugins_to_blame, providing
from bayes_body.registry import find, names
from bayes_body.session.read import FILE_NAME
from bayes_body.session.session import Session
from bayes_body.storage.run_file import places_of
from bayes_body.tracking.draws import Draws
from bayes_body.tracking.track import track

# Of a row's figures; None where one does not exist.
FIGURES = ("seconds_per_frame", "ess_per_second", "error_mm_mean", "coverage_90", "log_evidence", "frames_lost")
# Whose change makes other figures.
PACKAGES = ("bayes-body", "jax")

type Row = dict[str, Any]


class Pair(NamedTuple):
    """A definition (a name or a path) and a kernel's name."""

    model: str
    kernel: str


@dataclass(frozen=True)
class Settings:
    """How large the runs of a matrix are.

    Attributes:
        frames: of each.
        most_particles: a kernel's own number, but no more than so many; None leaves it.
        runs: independent filters.
        seed: of everything random.
        session: folder of a recording to try them all on; None takes scenes of our own (`Scenes`).
    """

    frames: int = 60
    most_particles: int | None = None
    runs: int = 1
    seed: int = 0
    session: Path | None = None


QUICK = Settings(frames=5, most_particles=200)


def pairs(models: Sequence[str] = (), kernels: Sequence[str] = ()) -> tuple[Pair, ...]:
    """Definitions by kernels, in the order in which they are listed.

    Args:
        models: definitions, by name or path; all that ship by default.
        kernels: all that are registered by default.

    Raises:
        InputError: there is no such kernel.
    """
    for kernel in kernels:
        find("kernel", kernel)
    return tuple(Pair(model, kernel) for model in models or definition_names() for kernel in kernels or names("kernel"))


def benchmark_rows(asked: Sequence[Pair], settings: Settings, folder: Path, done: Collection[Row] = ()) -> Iterator[Row]:
    """A row for each pair, as soon as it is known; what goes wrong with one is its own matter.

    Args:
        asked: which pairs.
        settings: how large the runs are.
        folder: where scenes are made; it must outlast the iteration.
        done: rows that are there already: one that was made with the same settings is taken as it is, unless it failed.

    Yields:
        model, kernel, scene, `made_of` (what the figures depend on), FIGURES, and either `why_not`, `error` or neither.
    """
    scenes = Scenes(folder, settings.frames, settings.seed, settings.session)
    kept = {(row.get("model"), row.get("kernel")): row for row in done}
    for pair in asked:
        before = kept.get(pair, {})
        row: Row = {
            "model": pair.model,
            "kernel": pair.kernel,
            "scene": None,
            "made_of": None,
            **dict.fromkeys(FIGURES),
            "why_not": None,
            "error": None,
        }
        try:
            with plugins_to_blame():
                definition = load_definition(pair.model)
                options = options_of(definition, pair.kernel, settings.most_particles)
                row["made_of"] = _made_of(definition, pair.kernel, options, settings)
                if before.get("made_of") == row["made_of"] and before.get("error") is None:
                    yield before
                    continue
                scene, draws = followed(scenes, definition, pair.kernel, options, settings)
                row |= {"scene": scene.kind, **measured(scene.session, draws)}
        except InputError as error:
            row["why_not"] = str(error)
        except Exception as error:
            row |= {"error": f"{type(error).__name__}: {error}", "details": traceback.format_exc()}
        yield row


def options_of(definition: Definition, kernel: str, most_particles: int | None) -> Any:
    """A kernel's options: the definition's where it is the definition's kernel, else the kernel's own defaults; with no more particles than given.

    Raises:
        InputError: there is no such kernel.
    """
    _, options = kernel_options(definition, kernel)
    if most_particles is None or options.particles <= most_particles:
        return options
    return kernel_options(definition, kernel, {"particles": most_particles})[1]


def followed(scenes: Scenes, definition: Definition, kernel: str, options: Any, settings: Settings) -> tuple[Scene, Draws]:
    """A model's scene, and what a kernel makes of it.

    Raises:
        InputError: the view does not exist: no data to follow, or not what this kernel needs.
    """
    scene = scenes.of(definition)
    frames = min(settings.frames, scene.session.frames)
    built, key = find("kernel", kernel).build(options=options), jax.random.key(settings.seed)
    return scene, track(scene.session, scene.model, built, key, options.particles, settings.runs, frames)


def measured(session: Session, draws: Draws) -> dict[str, Any]:
    """FIGURES of a run.

    The effective samples a second count every frame of every run; those of a mode seeker are no samples of the posterior, and do not count.
    """
    working, evidence = draws.timing.total - draws.timing.compile, log_evidence(draws)
    mode_seeker = np.isnan([frame.info.log_evidence for frame in draws.frames]).all()
    accuracy = accuracy_figures(draws_against_truth(session, draws), bool(mode_seeker))
    ess = float(sum(np.sum(frame.info.ess) for frame in draws.frames))
    return {
        "seconds_per_frame": working / len(draws.frames),
        "ess_per_second": None if mode_seeker else ess / working,
        "error_mm_mean": accuracy["error_mm_mean"],
        "coverage_90": accuracy["coverage_90"],
        "log_evidence": evidence if np.isfinite(evidence) else None,
        "frames_lost": len(draws.frames_lost),
    }


def _made_of(definition: Definition, kernel: str, options: Any, settings: Settings) -> dict[str, Any]:
    """All that the figures depend on, in short: a row whose own is the same need not be made again."""
    recording = None if settings.session is None else _short((settings.session / FILE_NAME).read_text(encoding="utf-8-sig"))
    return {
        "definition": _short(definition.text + definition.body_text),
        "options": {name: list(value) if isinstance(value, tuple) else value for name, value in options.model_dump().items()},
        "frames": settings.frames,
        "runs": settings.runs,
        "seed": settings.seed,
        "session": recording,
        "plugins": {plugin.path.name: _short(plugin.text) for plugin in providing(places_of(definition, kernel))},
        "versions": {package: version(package) for package in PACKAGES},
    }


def _short(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:12]
