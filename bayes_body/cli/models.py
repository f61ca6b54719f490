"""`bayes-body models`: list the definitions, check a user's own, and draw the anatomical axes of its body."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from typer.core import TyperGroup

from bayes_body.cli.plugin_option import Plugins, own_terms
from bayes_body.cli.terminal import say, show

if TYPE_CHECKING:
    from bayes_body.model.definition import Definition

# Any value will do: it scales the noise, and no check depends on it.
SOME_FPS = 60.0


class _ListByDefault(TyperGroup):
    """Make `bayes-body models` without a command mean `bayes-body models list`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        return super().parse_args(ctx, args or ["list"])


app = typer.Typer(cls=_ListByDefault, help="List the model definitions (the default), check one, or draw its body's axes.")


@app.command("list")
def list_models() -> None:
    """List the definitions that ship, one line each, by what they read of a recording."""
    from rich.table import Table

    from bayes_body.base.files.shipped import definitions_folder
    from bayes_body.base.registry import EVIDENCE
    from bayes_body.model.body.solids import configuration_space
    from bayes_body.model.build import body_of
    from bayes_body.model.definition import definition_names, evidence_of, load_definition

    table = Table("model", "reads", "dofs", "kernel", "what it is", box=None, pad_edge=False)
    definitions = [load_definition(name) for name in definition_names()]
    places = {
        definition.name: [EVIDENCE.index(evidence) for evidence in evidence_of(definition) if evidence in EVIDENCE] for definition in definitions
    }
    for definition in sorted(definitions, key=lambda definition: (definition.body_name.startswith("arm"), places[definition.name])):
        dofs = str(configuration_space(body_of(definition)).dimension)
        table.add_row(definition.name, ", ".join(evidence_of(definition)), dofs, definition.kernel.kind, definition.title)
    show(table, f"The files are in {definitions_folder()}; copy one to make your own.")


@app.command()
def check(file: str = typer.Argument(help="A definition's name or the path of your own .toml file."), plugin: Plugins = None) -> None:
    """Check a definition, and print one sentence for each fault in it. Terms of a plugin are built and called, in a room without a recording."""
    with own_terms(plugin):
        definition = checked_definition(file)
        if plugin:
            _call_terms(definition)
    terms = ", ".join(term.kind for term in (*definition.likelihoods, *definition.constraints))
    say(f"{file}: valid: {definition.title} (body {definition.body_name}; {definition.dynamics.kind}; {terms}; {definition.kernel.kind}).")


def _call_terms(definition: "Definition") -> None:
    from bayes_body.base.config import configure

    configure()
    from bayes_body.base.registry import find
    from bayes_body.workshop.calibration.scene import model_in_a_room, probe

    kernel = definition.kernel
    probe(model_in_a_room(definition), find("kernel", kernel.kind).build(options=kernel.options), runs=False)


@app.command(short_help="Print the JSON Schema of a definition, for editors.")
def schema(plugin: Plugins = None) -> None:
    """Print the JSON Schema of a definition. An editor that has it completes keys, explains them, and marks faults while you type."""
    import json

    from bayes_body.model.json_schema import definition_schema

    with own_terms(plugin):
        say(json.dumps(definition_schema(), indent=1))


@app.command(short_help="Draw the anatomical axes of a definition's body.")
def axes(
    file: str = typer.Argument(help="A definition's name or the path of your own .toml file."),
    out: Path = typer.Option(Path("axes.png"), "--out", help="The picture, .png."),
    overwrite: bool = typer.Option(False, "--overwrite", help="Replace an existing file."),
    plugin: Plugins = None,
) -> None:
    """Draw the anatomical axes of a definition's body and the positive directions of its clinical angles, and list the angles."""
    from bayes_body.base.files.atomic import check_free, make_folder
    from bayes_body.model.build import body_of
    from bayes_body.model.definition import load_definition
    from bayes_body.view.anatomical_axes import draw_axes

    with own_terms(plugin):
        definition = load_definition(file)
    check_free(out, overwrite)
    make_folder(out.parent)
    names = draw_axes(body_of(definition), definition.body.clinical, out)
    say(f"{out}: {len(names)} clinical angles of the body {definition.body_name}: {', '.join(names)}.")


def checked_definition(name: str) -> "Definition":
    """Return the definition after a check that it fits its body. Options of single dofs are only checked when the terms are built.

    Raises:
        InputError: something in the file is wrong; each sentence names one fault.
    """
    from bayes_body.base.errors import InputError
    from bayes_body.base.registry import find
    from bayes_body.model.build import body_of
    from bayes_body.model.definition import load_definition

    definition = load_definition(name)
    try:
        body = body_of(definition)
        find("dynamics", definition.dynamics.kind).build(options=definition.dynamics.options, body=body, fps=SOME_FPS, subject_sd={})
        for term in definition.constraints:
            find("potential", term.kind).build(name=term.kind, options=term.options, body=body)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None
    return definition
