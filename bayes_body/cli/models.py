"""`bayes-body models`: what definitions there are, and what is wrong with a user's own."""

import typer
from rich.console import Console
from rich.table import Table

app = typer.Typer(help="List the model definitions, or check one.", invoke_without_command=True)


@app.callback()
def list_models(context: typer.Context) -> None:
    """List the shipped definitions, a line each."""
    if context.invoked_subcommand:
        return
    from bayes_body.definition import definition_names, definitions_folder, load_definition

    table = Table("model", "dofs", "kernel", "what it is", box=None, pad_edge=False)
    for name in definition_names():
        definition = load_definition(name)
        dofs = sum(len(joint.dofs) for joint in definition.body.joints)
        table.add_row(name, str(dofs), definition.kernel.kind, definition.title)
    # Console() alone would wrap to 80 columns where the output is piped.
    console = Console() if Console().is_terminal else Console(width=160)
    console.print(table)
    console.print(f"The files lie in {definitions_folder()}; copy one to make your own.", highlight=False, soft_wrap=True)


@app.command()
def check(file: str = typer.Argument(help="A definition's name or the path of your own .toml file.")) -> None:
    """Say in one sentence each what is wrong with a definition."""
    from bayes_body.definition import load_definition

    definition = load_definition(file)
    terms = ", ".join(term.kind for term in (*definition.likelihoods, *definition.constraints))
    typer.echo(f"{file}: sound: {definition.title} (body {definition.body_name}; {definition.dynamics.kind}; {terms}; {definition.kernel.kind}).")
