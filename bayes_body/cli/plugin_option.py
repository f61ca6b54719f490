"""`--plugin`, an option of every command that works with models: the only way to run a user's own code."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

HELP = "Your own Python file with terms that the model names; may be given more than once. It is executed: only give files that you trust."

# Not a `type` statement, because typer does not resolve it.
Plugins = Annotated[list[Path] | None, typer.Option("--plugin", help=HELP, show_default=False)]


@contextmanager
def own_terms(files: list[Path] | None) -> Iterator[None]:
    """Within it, the terms of these files are registered. An error in a plugin's code gives a sentence that names its line.

    Raises:
        InputError: a plugin cannot be used, or fails.
    """
    # Without plugins, the modules that load them need not be imported.
    if not files:
        yield
        return
    from bayes_body.model.plugins.load import load_plugin, plugins_to_blame

    for file in files:
        load_plugin(file)
    with plugins_to_blame():
        yield
