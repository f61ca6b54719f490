"""Help pages: rich takes words in brackets for its own markup and drops them, so that no text may hold any."""

import pytest
import typer
from rich.markup import render

from bayes_body.base import registry
from bayes_body.cli.main import app


def commands(command, path="bayes-body"):
    yield path, command
    for name, inner in getattr(command, "commands", {}).items():
        yield from commands(inner, f"{path} {name}")


COMMANDS = dict(commands(typer.main.get_command(app)))


@pytest.mark.parametrize("path", COMMANDS)
def test_nothing_is_dropped_from_a_help_page(path):
    command = COMMANDS[path]
    texts = [command.help, *(getattr(parameter, "help", None) for parameter in command.params)]
    for text in filter(None, texts):
        assert render(text).plain == text


def test_a_word_in_brackets_would_be_dropped():
    assert render("the [[likelihood.scale]] tables").plain != "the [[likelihood.scale]] tables"


@pytest.mark.parametrize("verb", ["track", "check"])
def test_every_kernel_is_named_where_one_is_chosen(verb):
    (option,) = (each for each in COMMANDS[f"bayes-body {verb}"].params if each.name == "kernel")
    assert all(name in option.help for name in registry.names("kernel"))
