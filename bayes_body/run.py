"""A whole run on disk: track a session, and leave behind all that is needed to inspect and to repeat it.

`run.toml` is written first, the posterior before the pictures: what is computed is kept even if what comes after fails.
"""

import json
import platform
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import tomlkit

from bayes_body.definition import Definition, load_definition
from bayes_body.errors import wrong
from bayes_body.files import make_folder, write_text
from bayes_body.metrics import lost_frames, summarise
from bayes_body.model import load_model
from bayes_body.posterior import save_posterior, to_datatree
from bayes_body.registry import find
from bayes_body.session import load_session
from bayes_body.toml_file import validate
from bayes_body.tracking import track
from bayes_body.view.overlay import draw_overlay
from bayes_body.view.progress import progress_bar, watched

# A folder with run.toml alone is a run that stopped before it had anything to keep: it may be tried again.
LEFT_BY_A_RUN = ("posterior.nc", "summary.json")
PACKAGES = ("bayes-body", "jax", "jaxlib", "numpyro", "blackjax", "arviz", "opencv-python-headless", "numpy")


@dataclass(frozen=True)
class Settings:
    """What a run is made of.

    Attributes:
        session: folder of the session.
        model: a definition's name or path.
        kernel: a kernel's name; None takes the definition's.
        overrides: options of the kernel that differ from the definition's.
        runs: independent filters.
        frames: how many frames; None takes all.
        seed: of everything random.
        out: folder of the run.
    """

    session: Path
    model: str
    kernel: str | None
    overrides: Mapping[str, int]
    runs: int
    frames: int | None
    seed: int
    out: Path


def run(settings: Settings, show: Callable[[str], None], bar: bool) -> dict[str, Any]:
    """Track and write everything; returns what `summary.json` holds.

    Args:
        settings: the run.
        show: takes lines for the user.
        bar: whether a progress bar is drawn on standard error.

    Raises:
        InputError: an input cannot be used, or the folder holds another run.
    """
    _refuse_another_run(settings.out)
    session = load_session(settings.session)
    definition = load_definition(settings.model)
    kind, options = kernel_options(definition, settings.kernel, settings.overrides)
    term = find("kernel", kind)
    kernel = term.build(options=options)
    model = load_model(definition, session)
    _write_run_file(settings, definition, kind, options.model_dump())
    if term.note:
        show(f"{kind}: {term.note}")
    with progress_bar(bar) as on_frame:
        draws = track(session, model, kernel, jax.random.key(settings.seed), options.particles, settings.runs, settings.frames, on_frame)
    save_posterior(to_datatree(draws, {"kernel": kind, "seed": settings.seed}), settings.out / "posterior.nc")
    layers = getattr(options, "layers", 1)
    summary = summarise(session, draws, kernel=kind, layers=layers, seed=settings.seed, watch=watched("overlap", bar))
    write_text(settings.out / "summary.json", json.dumps(summary, indent=2) + "\n")
    draw_overlay(session, draws, settings.out, watched("pictures", bar))
    show(_figures(summary))
    if draws.frames_lost:
        show(lost_frames(draws))
    return summary


def kernel_options(definition: Definition, kind: str | None, overrides: Mapping[str, int]) -> tuple[str, Any]:
    """The kernel's name and options: the definition's where it is the definition's kernel, else that kernel's own defaults; `overrides` go first.

    Raises:
        InputError: there is no such kernel, or an option that it does not have or may not have.
    """
    kind = kind or definition.kernel.kind
    schema = find("kernel", kind).options
    given = definition.kernel.options.model_dump() if kind == definition.kernel.kind else {}
    for name in overrides:
        if name not in schema.model_fields:
            raise wrong(f"--{name}", f"the kernel '{kind}' has no such option", f"one of {', '.join(schema.model_fields)}", "leave it out")
    return kind, validate(schema, given | dict(overrides), "the kernel's options")


def _refuse_another_run(out: Path) -> None:
    for name in LEFT_BY_A_RUN:
        if (out / name).exists():
            raise wrong(out, f"holds another run ({name})", "a folder without one", "name another with --out, or remove this one")
    make_folder(out)


def _write_run_file(settings: Settings, definition: Definition, kind: str, options: Mapping[str, Any]) -> None:
    """All that is needed to repeat the run: settings, the kernel's every option, versions, and the definition's own text."""
    document = tomlkit.document()
    document.add(tomlkit.comment("Made by bayes-body track. The same settings with the same versions on the same kind of processor repeat the run."))
    table = tomlkit.table()
    table.update({"session": str(settings.session.resolve()), "model": settings.model, "runs": settings.runs, "seed": settings.seed})
    if settings.frames is not None:
        table["frames"] = settings.frames
    document["run"] = table
    document["kernel"] = {"kind": kind, **options}
    document["versions"] = {"python": platform.python_version(), **{package: version(package) for package in PACKAGES}}
    document["machine"] = {"platform": platform.platform(), "devices": [str(device) for device in jax.devices()]}
    texts = {"text": definition.text, "body_text": definition.body_text}
    document["definition"] = {"title": definition.title, **{key: tomlkit.string(text, multiline=True) for key, text in texts.items() if text}}
    write_text(settings.out / "run.toml", tomlkit.dumps(document))


def _figures(summary: Mapping[str, Any]) -> str:
    """The run in a few lines, with units."""

    def shown(key: str, form: str, unit: str) -> str:
        return "-" if summary[key] is None else f"{summary[key]:{form}}{unit}"

    return "\n".join(
        [
            f"frames      {summary['frames']}, lost {summary['frames_lost']}; {summary['cameras']} cameras, {summary['dof']} dofs",
            f"time        {shown('seconds_per_frame', '.3f', ' s')} a frame; compilation {shown('seconds_compile', '.1f', ' s')}; "
            f"{shown('evaluations_per_second', ',.0f', '')} evaluations/s; {shown('peak_memory_mb', ',.0f', ' MB')}",
            f"particles   effective {shown('ess_median', '.0f', '')} (median), {shown('ess_min', '.0f', '')} (least) of {summary['particles']}",
            f"agreement   overlap with the silhouettes (IoU) {shown('iou_median', '.3f', '')}; R-hat over runs at most {
                shown('rhat_max', '.2f', '')
            }; "
            f"mean markers of the runs {shown('marker_disagreement_mm', '.0f', ' mm')} apart",
        ]
    )
