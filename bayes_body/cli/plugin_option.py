"""`--plugin`, of every verb that works with models: the only way in which a user's own code is run."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

HELP = "A Python file of your own whose terms the model names; may be given more than once. It is run, so give no stranger's."

# Not a `type` statement: typer does not look behind one.
Plugins = Annotated[list[Path] | None, typer.Option("--plugin", help=HELP, show_default=False)]


@contextmanager
def own_terms(files: list[Path] | None) -> Iterator[None]:
    """Inside, the terms of these files have their names; what fails in a plugin's code is a sentence that names its line.

    Raises:
        InputError: a plugin cannot be used, or fails.
    """
    # Without a plugin its checks need not be imported.
    if not files:
        yield
        return
    from bayes_body.plugins.load import load_plugin, plugins_to_blame

    for file in files:
        load_plugin(file)
    with plugins_to_blame():
        yield
