"""The options of a run's kernel: from the definition, from a continued run, and from the command line."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from pydantic import BaseModel

from bayes_body.base.errors import InputError, input_error, nearest
from bayes_body.base.registry import FewCameras, find
from bayes_body.base.toml.read import validate
from bayes_body.density.kernel import Kernel, NamedKernel
from bayes_body.model.definition import Definition

# Options that have their own flag in `bayes-body track`; the others are given by --set.
FLAGS = ("particles", "layers", "move", "moves", "leapfrog_steps")


def kernel_options(
    definition: Definition,
    kind: str | None = None,
    overrides: Mapping[str, Any] | None = None,
    stored: Mapping[str, Any] | None = None,
    cameras: int | None = None,
) -> tuple[str, Any]:
    """Return a kernel's name and its validated options.

    The options are those of the definition if it names this kernel, else the kernel's defaults. `overrides` replace single options.
    If no kernel is named, and the recording has too few cameras for that of the definition, it is another one (`registry.FewCameras`). That one has
    the options that stand there, also if it is named.

    Args:
        definition: the model's definition.
        kind: the kernel's name; None for that of the definition.
        overrides: options given for this run.
        stored: kernel and options of the continued run; they replace those of the definition if the kernel is the same.
        cameras: number of cameras that see what the model reads; None if there is no recording.

    Raises:
        InputError: there is no such kernel, it has no such option, or an option's value is not allowed.
    """
    few, overrides = few_cameras(definition.kernel.kind, cameras), overrides or {}
    kind = kind or (few.kernel if few else definition.kernel.kind)
    schema, alternative = find("kernel", kind).options, find("kernel", definition.kernel.kind).few_cameras
    options: dict[str, Any] = {}
    if kind == definition.kernel.kind:
        options = definition.kernel.options.model_dump()
    elif alternative and kind == alternative.kernel:
        options = dict(alternative.options)
    if stored and stored.get("kind") == kind:
        options = {name: value for name, value in stored.items() if name != "kind"}
    for name in overrides:
        if name not in schema.model_fields:
            problem, expected = f"the kernel '{kind}' has no such option", f"one of {', '.join(schema.model_fields)}"
            raise input_error(f"--{name.replace('_', '-')}" if name in FLAGS else f"--set {name}", problem, expected, "leave it out")
    return kind, validate(schema, options | dict(overrides), f"the options of the kernel '{kind}'")


def few_cameras(kind: str, cameras: int | None) -> FewCameras | None:
    """Return what is taken by default instead of a kernel for so few cameras; None if it serves them."""
    few = find("kernel", kind).few_cameras
    return few if few and cameras is not None and cameras < few.cameras else None


def kernel_sentences(definition: Definition, kind: str, cameras: int) -> tuple[str, str]:
    """Return a line that says which kernel was chosen and why, and a warning if it was named in spite of too few cameras; each may be empty.

    Args:
        definition: the model's definition.
        kind: the kernel that is used.
        cameras: number of cameras that see what the model reads.
    """
    alternative, few = find("kernel", definition.kernel.kind).few_cameras, few_cameras(definition.kernel.kind, cameras)
    seeing = f"{cameras} camera{'' if cameras == 1 else 's'}"
    line = ""
    if alternative and kind == definition.kernel.kind and not few:
        line = f"kernel     {kind}, because {seeing} have what the model reads; --kernel names another."
    if few and kind == few.kernel:
        line = f"kernel     {kind}, because with {seeing} {few.reason}; --kernel names another."
    unfit = few_cameras(kind, cameras)
    return line, f"the kernel {kind} with {seeing}: {unfit.reason}; use --kernel {unfit.kernel}." if unfit else ""


def unknowns_sentence(kind: str, options: Any, unknowns: Sequence[str]) -> str:
    """Return a warning if a kernel with these options follows unknowns by its particles; empty if it does not.

    Args:
        kind: the kernel's name.
        options: its validated options.
        unknowns: the names of the model's unknowns.
    """
    term = find("kernel", kind)
    if not unknowns or not term.predicts_by_particles(options):
        return ""
    followed = ", ".join(name.replace("_", " ") for name in unknowns)
    consequence = "after some frames all of them descend from a few, and what hardly moves has too narrow an interval"
    itself = "--set prediction=gaussian" if "prediction" in term.options.model_fields else "--kernel tempered --set prediction=gaussian"
    return f"the kernel {kind} follows the unknowns ({followed}) by its particles: {consequence}; use {itself}, or --kernel laplace."


def check_options(kind: str, changes: Mapping[str, Any]) -> None:
    """Refuse options that a kernel does not have, in the words of `Model.kernel`.

    Raises:
        InputError: there is no such kernel, or it has no such option.
    """
    fields = find("kernel", kind).options.model_fields
    for name in changes:
        if name not in fields:
            raise InputError(f"model.kernel({name}=...): the kernel '{kind}' has no such option; {nearest(name, fields)}")


# The latest kernels, by build function, name and options.
_BUILT: dict[tuple[Callable[..., Kernel], str, str], NamedKernel] = {}
MOST_BUILT = 8


def kernel_of(kind: str, options: BaseModel) -> NamedKernel:
    """Return a kernel with validated options: the same object each time, so that its compiled program can be used again.

    Raises:
        InputError: there is no such kernel.
    """
    # A plugin may be registered again, with other code under the same name.
    build = find("kernel", kind).build
    place = (build, kind, repr(options))
    if place not in _BUILT:
        while len(_BUILT) >= MOST_BUILT:
            _BUILT.pop(next(iter(_BUILT)))
        _BUILT[place] = NamedKernel(kind, options, build(options=options))
    return _BUILT[place]
