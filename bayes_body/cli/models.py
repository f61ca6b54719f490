"""`bayes-body models`: what definitions there are, and what is wrong with a user's own."""

from typing import TYPE_CHECKING, Any

import typer
from rich.console import Console
from rich.table import Table
from typer.core import TyperGroup

from bayes_body.cli.plugin_option import Plugins, own_terms

if TYPE_CHECKING:
    from bayes_body.model.definition import Definition

# Any will do: it scales the noise and nothing that could be wrong depends on it.
SOME_FPS = 60.0


class _ListByDefault(TyperGroup):
    """`bayes-body models` alone is `bayes-body models list`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        return super().parse_args(ctx, args or ["list"])


app = typer.Typer(cls=_ListByDefault, help="List the model definitions (what it does without a command), or check one.")


@app.command("list")
def list_models() -> None:
    """List the shipped definitions, a line each."""
    from bayes_body.model.definition import definition_names, definitions_folder, load_definition

    table = Table("model", "dofs", "kernel", "what it is", box=None, pad_edge=False)
    for name in definition_names():
        definition = load_definition(name)
        dofs = sum(not dof.is_fixed for joint in definition.body.joints for dof in joint.dofs)
        table.add_row(name, str(dofs), definition.kernel.kind, definition.title)
    # Console() alone would wrap to 80 columns where the output is piped.
    console = Console() if Console().is_terminal else Console(width=160)
    console.print(table)
    console.print(f"The files lie in {definitions_folder()}; copy one to make your own.", highlight=False, soft_wrap=True)


@app.command()
def check(file: str = typer.Argument(help="A definition's name or the path of your own .toml file."), plugin: Plugins = None) -> None:
    """Say in one sentence each what is wrong with a definition."""
    with own_terms(plugin):
        definition = checked_definition(file)
    terms = ", ".join(term.kind for term in (*definition.likelihoods, *definition.constraints))
    typer.echo(f"{file}: sound: {definition.title} (body {definition.body_name}; {definition.dynamics.kind}; {terms}; {definition.kernel.kind}).")


def checked_definition(name: str) -> "Definition":
    """The definition, once it is known to fit its body: what its terms say of single dofs is read only when they are built.

    Raises:
        InputError: anything in the file is wrong; each sentence names it.
    """
    from bayes_body.body.build import build_body
    from bayes_body.errors import InputError
    from bayes_body.model.definition import load_definition
    from bayes_body.registry import find

    definition = load_definition(name)
    try:
        body = build_body(definition.body_name, definition.body)
        find("dynamics", definition.dynamics.kind).build(options=definition.dynamics.options, body=body, fps=SOME_FPS, subject_sd={})
        for term in definition.constraints:
            find("potential", term.kind).build(name=term.kind, options=term.options, body=body)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None
    return definition
