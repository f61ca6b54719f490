"""README.md and the guide compared with the program: their examples run, and their tables are complete."""

import json
import re
import runpy
import types
from importlib import import_module

import pytest
from programs.pages import FIRST_RUN, README, ROOT, blocks, page, sections

from bayes_body.base.toml.options import json_schema, options_of
from bayes_body.cli.main import main
from bayes_body.model.body import schema, tables
from bayes_body.model.definition import definition_names, load_definition

# These programs run for longer than they compile.
pytestmark = pytest.mark.usefixtures("optimised")

DEFINITIONS = page("docs/guide/definitions.md")

SETTING_UP = ["python3 -m pip install uv && python3 -m uv run bayes-body demo", "python3 -m pip install uv && python3 -m uv run pytest"]


def keys(table: str) -> set[str]:
    """What the first column of a table names."""
    cells = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    return {key for cell in cells for key in re.findall(r"`([^`]*)`", cell)}


def test_the_readme_has_the_lines_that_set_it_up():
    commands = [block.strip() for block in blocks(README, "sh")]
    assert commands[0] == SETTING_UP[0] and SETTING_UP[1] in commands


def test_the_readme_opens_with_three_sentences_and_a_picture():
    opening, picture = README.split("\n\n")[1:3]
    assert len(re.findall(r"\.(?:\s|$)", opening)) == 3
    assert picture.startswith("![")


def test_the_readme_recommends_models_that_ship():
    taken = set(re.findall(r"^\|[^|]*\| `(\w+)` \|", sections(README)["Which model do I take?"], re.MULTILINE))
    assert {"keypoints", "silhouettes"} <= taken <= set(definition_names())


def test_the_readme_lists_a_few_models_and_the_documentation_every_one():
    few, table = keys(sections(README)["Models"]), page("docs/models.md")
    assert {"keypoints", "silhouettes"} <= few <= set(definition_names()) == keys(table) and len(few) <= 7
    for name in definition_names():
        for text in (table, *([sections(README)["Models"]] if name in few else [])):
            (row,) = [line for line in text.splitlines() if line.startswith(f"| `{name}`")]
            assert row.split("|")[-2].strip() == f"`{load_definition(name).kernel.kind}`"


@pytest.mark.parametrize("text", [README, FIRST_RUN], ids=["README", "first_run"])
def test_links_lead_somewhere(text):
    folder = ROOT if text is README else ROOT / "docs" / "guide"
    for target in re.findall(r"\]\(([^)#]+)(?:#[\w-]*)?\)", text):
        assert (folder / target).exists(), target


def test_the_guide_s_commands_are_the_readme_s():
    for command in [line for line in "".join(blocks(FIRST_RUN, "sh")).splitlines() if line.startswith("bayes-body")]:
        assert command in README


@pytest.mark.slow
def test_every_key_of_the_summary_is_explained(walked):
    summary = json.loads((walked / "walk_run" / "summary.json").read_text())
    assert keys(sections(FIRST_RUN)["What is in the run's folder"]) == set(summary)


def test_every_option_of_the_command_line_is_explained(capsys):
    with pytest.raises(SystemExit):
        main(["track", "--help"])
    shown = set(re.findall(r"--[\w-]+", capsys.readouterr().out)) - {"--help"}
    assert keys(sections(FIRST_RUN)["Track"]) == shown


TABLES = runpy.run_path(str(ROOT / "docs" / "option_tables.py"))
SCHEMAS = TABLES["definition_schemas"]()


def test_the_tables_of_options_are_those_of_the_schemas():
    for name in TABLES["schemas"]():
        text = (TABLES["GUIDE"] / name).read_text(encoding="utf-8")
        assert TABLES["with_tables"](name, text) == text, "run `python docs/option_tables.py`"


@pytest.mark.parametrize("heading", SCHEMAS)
def test_every_option_is_explained_and_described_for_editors(heading):
    schema = SCHEMAS[heading]
    options = options_of(schema)
    assert {option.key for option in options} == {field.alias or name for name, field in schema.model_fields.items()}
    for option in options:
        assert option.text, f"{schema.__module__}: {option.key}: write what it is below the field"
        assert json_schema(schema)["properties"][option.key]["description"].startswith(option.text.replace("`", ""))


@pytest.mark.parametrize(
    ("heading", "table"),
    [
        ("The body itself", schema.BodySchema),
        ("`[[joint]]`", tables.Joint),
        ("A dof", tables.Dof),
        ("`[[part]]`", tables.Part),
        ("`[clinical]`", tables.Segment),
    ],
)
def test_every_key_of_a_table_is_explained(heading, table):
    explained = keys(sections(DEFINITIONS)[heading])
    assert explained == {field.alias or name for name, field in table.model_fields.items()}


@pytest.mark.parametrize("example", ["whole file", "named body", "body file"])
def test_toml_of_the_guide_is_valid(tmp_path, example, capsys):
    model, named, pendulum = blocks(DEFINITIONS, "toml")
    (tmp_path / "pendulum.toml").write_text(pendulum, encoding="utf-8")
    if example != "whole file":
        # Neither body has knees or shifts.
        model = model.replace('[dynamics.sd_m]\n"root_*" = 0.015\n', "").replace('"?_knee" = 8.0\n', "")
        body = named if example == "named body" else f'[body]\nname = "{tmp_path}/pendulum.toml"\n'
        model = model.replace('[body]\nname = "deutscher_31"\n', body)
    (tmp_path / "mine.toml").write_text(model, encoding="utf-8")
    with pytest.raises(SystemExit) as stopped:
        main(["models", "check", str(tmp_path / "mine.toml")])
    assert stopped.value.code == 0, capsys.readouterr().err


def test_public_names_mean_the_same_whatever_was_imported_before():
    # A module that has the name of a function takes its place in the package once it is imported.
    import bayes_body as bb
    import bayes_body.runs.run

    members = set(bb.__all__) - {"compare", "kernels", "metrics", "posterior"}
    assert {name for name in members if isinstance(getattr(bb, name), types.ModuleType)} == set()


def test_the_api_page_shows_every_public_name():
    import bayes_body as bb

    text = page("docs/api.md")
    shown = re.findall(r"^::: ([\w.]+)\.(\w+)\n    options:\n      heading: bb\.(\w+)$", text, re.MULTILINE)
    modules = re.findall(r"^\| `bb\.(\w+)` \|", text, re.MULTILINE)
    assert sorted([name for _, _, name in shown] + modules) == bb.__all__
    assert [name for module, name, heading in shown if getattr(import_module(module), name) is not getattr(bb, heading)] == []


def test_the_tests_that_the_map_of_statistics_names_exist():
    named = re.findall(r"`([\w/]+\.py): (test_\w+)`", page("docs/guide/statistics.md"))
    assert len(named) > 25
    missing = [(file, test) for file, test in named if f"def {test}(" not in (ROOT / "tests" / file).read_text(encoding="utf-8")]
    assert missing == []


def test_the_tests_that_keep_the_promises_exist():
    named = re.findall(r"`([\w/]+/test_\w+\.py)`", page("docs/guide/promises.md"))
    assert len(named) > 15 and [file for file in named if not (ROOT / "tests" / file).is_file()] == []
