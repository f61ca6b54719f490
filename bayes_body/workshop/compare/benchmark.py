"""A benchmark of every kernel on every definition, and one sentence for each pair that cannot be run.

The registry lists kernels and definitions, so a new kernel or definition is included automatically.
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

from bayes_body.base.errors import InputError
from bayes_body.base.registry import find, names
from bayes_body.model.definition import Definition, definition_names, load_definition
from bayes_body.model.kernel_options import kernel_of, kernel_options
from bayes_body.model.plugins.load import plugins_to_blame, providing
from bayes_body.recording.session.read import FILE_NAME
from bayes_body.recording.session.session import Session
from bayes_body.results.metrics import accuracy_figures, draws_against_truth, log_evidence
from bayes_body.results.storage.run_file import places_of
from bayes_body.tracking.draws import Draws
from bayes_body.tracking.track import track
from bayes_body.workshop.compare.scenes import Scene, Scenes

# Names of the figures in a row, those of the accuracy first; a figure that does not exist is None.
ACCURACY = ("error_mm_mean", "error_mm_relative", "coverage_90", "ece_radial", "ece_radial_by_marker", "tarp", "crps_mm")
FIGURES = ("seconds_per_frame", "ess_per_second", *ACCURACY, "log_evidence", "frames_lost")
# Packages whose version affects the figures.
PACKAGES = ("bayes-body", "jax")

type Row = dict[str, Any]


class Pair(NamedTuple):
    """A definition (a name or a path) and a kernel's name."""

    model: str
    kernel: str


@dataclass(frozen=True)
class Settings:
    """The sizes of the benchmark's runs.

    Attributes:
        frames: frames of each run.
        most_particles: upper limit on a kernel's own number of particles; None: no limit.
        runs: number of independent filters.
        seed: the seed of everything random.
        session: folder of a recording to use for all; None: generated scenes (`Scenes`).
    """

    frames: int = 60
    most_particles: int | None = None
    runs: int = 1
    seed: int = 0
    session: Path | None = None


QUICK = Settings(frames=5, most_particles=200)


def pairs(models: Sequence[str] = (), kernels: Sequence[str] = ()) -> tuple[Pair, ...]:
    """All pairs of definitions and kernels, in the order in which they are listed.

    Args:
        models: definitions, by name or path; default: all that ship.
        kernels: default: all that are registered.

    Raises:
        InputError: there is no such kernel.
    """
    for kernel in kernels:
        find("kernel", kernel)
    return tuple(Pair(model, kernel) for model in models or definition_names() for kernel in kernels or names("kernel"))


def benchmark_rows(asked: Sequence[Pair], settings: Settings, folder: Path, done: Collection[Row] = ()) -> Iterator[Row]:
    """Yield a row for each pair as soon as it is known. An error in one pair does not affect the others.

    Args:
        asked: the pairs.
        settings: the sizes of the runs.
        folder: for the scenes; it must exist during the iteration.
        done: existing rows. A row with the same settings is reused unless it failed.

    Yields:
        model, kernel, scene, `made_of` (what the figures depend on), FIGURES, and `why_not`, `error` or neither.
    """
    scenes = Scenes(folder, settings.frames, settings.seed, settings.session)
    existing = {(row.get("model"), row.get("kernel")): row for row in done}
    for pair in asked:
        existing_row = existing.get(pair, {})
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
                if existing_row.get("made_of") == row["made_of"] and existing_row.get("error") is None and set(FIGURES) <= set(existing_row):
                    yield existing_row
                    continue
                scene, draws = followed(scenes, definition, pair.kernel, options, settings)
                row |= {"scene": scene.kind, **measured(scene.session, draws)}
        except InputError as error:
            row["why_not"] = str(error)
        except Exception as error:
            row |= {"error": f"{type(error).__name__}: {error}", "details": traceback.format_exc()}
        yield row


def options_of(definition: Definition, kernel: str, most_particles: int | None) -> Any:
    """A kernel's options: the definition's if it names this kernel, else the kernel's defaults; with at most the given number of particles.

    Raises:
        InputError: there is no such kernel.
    """
    _, options = kernel_options(definition, kernel)
    if most_particles is None or options.particles <= most_particles:
        return options
    return kernel_options(definition, kernel, {"particles": most_particles})[1]


def followed(scenes: Scenes, definition: Definition, kernel: str, options: Any, settings: Settings) -> tuple[Scene, Draws]:
    """A model's scene, and a kernel's draws on it.

    Raises:
        InputError: the pair cannot be run: there are no data to follow, or the model lacks what this kernel needs.
    """
    scene = scenes.of(definition)
    frames = min(settings.frames, scene.session.frames)
    built, key = kernel_of(kernel, options), jax.random.key(settings.seed)
    return scene, track(key, scene.session, scene.model, built, options.particles, settings.runs, frames)


def measured(session: Session, draws: Draws) -> dict[str, Any]:
    """The FIGURES of a run.

    Effective samples per second count every frame of every run. A mode seeker's particles are not samples of the posterior, so it has none.
    """
    working, evidence = draws.timing.total - draws.timing.compile, log_evidence(draws)
    mode_seeker = not draws.samples_posterior
    accuracy = accuracy_figures(draws_against_truth(session, draws), mode_seeker)
    ess = float(sum(np.sum(frame.info.ess) for frame in draws.frames))
    return {
        "seconds_per_frame": working / len(draws.frames),
        "ess_per_second": None if mode_seeker else ess / working,
        **{name: accuracy[name] for name in ACCURACY},
        "log_evidence": evidence if np.isfinite(evidence) else None,
        "frames_lost": len(draws.frames_lost),
    }


def _made_of(definition: Definition, kernel: str, options: Any, settings: Settings) -> dict[str, Any]:
    """A digest of everything that the figures depend on. A row with the same digest need not be computed again."""
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
