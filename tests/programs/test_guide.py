"""README.md and the guide compared with the program: their examples run, and their tables are complete."""

import json
import re
import shlex
import tomllib
from pathlib import Path

import pytest
from pydantic import BaseModel

from bayes_body.body import schema, tables
from bayes_body.cli.main import main
from bayes_body.likelihood.edge_phase import Scale
from bayes_body.model.definition import definition_names, load_definition
from bayes_body.potentials.kinematic import Component
from bayes_body.registry import Room, find, names

# These programs run for longer than they compile.
pytestmark = pytest.mark.usefixtures("optimised")

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
FIRST_RUN = (ROOT / "docs" / "guide" / "first_run.md").read_text(encoding="utf-8")
DEFINITIONS = (ROOT / "docs" / "guide" / "definitions.md").read_text(encoding="utf-8")

SETTING_UP = ["python3 -m pip install uv && python3 -m uv run bayes-body demo", "python3 -m pip install uv && python3 -m uv run pytest"]


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def sections(text: str) -> dict[str, str]:
    """Headings and what stands below each, up to the next."""
    parts = re.split(r"^#+ (.*)$", text, flags=re.MULTILINE)[1:]
    return dict(zip(parts[::2], parts[1::2], strict=True))


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
    assert {"markers_31", "tempered_smc"} <= taken <= set(definition_names())


def test_the_readme_names_every_model():
    table = sections(README)["Models"]
    assert keys(table) == set(definition_names())
    for name in definition_names():
        (row,) = [line for line in table.splitlines() if line.startswith(f"| `{name}`")]
        assert row.split("|")[-2].strip() == f"`{load_definition(name).kernel.kind}`"


@pytest.mark.parametrize("text", [README, FIRST_RUN], ids=["README", "first_run"])
def test_links_lead_somewhere(text):
    folder = ROOT if text is README else ROOT / "docs" / "guide"
    for target in re.findall(r"\]\(([^)#]+)(?:#[\w-]*)?\)", text):
        assert (folder / target).exists(), target


@pytest.fixture(scope="module")
def walked(walk) -> Path:
    """The folder in which the guide's commands were given."""
    (command,) = [line for line in "".join(blocks(FIRST_RUN, "sh")).splitlines() if line.startswith("bayes-body track")]
    folder = walk.parent
    arguments = [str(folder / each) if each in ("walk", "walk_run") else each for each in shlex.split(command)[1:]]
    with pytest.raises(SystemExit) as stopped:
        main([*arguments, "--particles", "50"])
    assert stopped.value.code == 0
    return folder


def test_the_guide_s_commands_are_the_readme_s():
    for command in [line for line in "".join(blocks(FIRST_RUN, "sh")).splitlines() if line.startswith("bayes-body")]:
        assert command in README


@pytest.mark.slow
@pytest.mark.parametrize("number", range(len(blocks(FIRST_RUN, "python"))))
def test_python_of_the_guide_runs(walked, monkeypatch, number):
    monkeypatch.chdir(walked)
    exec(compile(blocks(FIRST_RUN, "python")[number], f"first_run.md #{number}", "exec"), {})


@pytest.mark.slow
def test_python_of_the_readme_runs(walk, monkeypatch, capsys):
    monkeypatch.chdir(walk.parent)
    block = _python_of_the_readme("A whole recording in a script")
    assert "density = model.density(model.observe(bb.read_frame(session, 0)))" in block
    exec(compile(block.replace("particles=200", "particles=50"), "README.md", "exec"), {})
    assert "silhouette_edges" in capsys.readouterr().out


@pytest.mark.long
def test_the_sampler_of_the_readme_runs(walk, monkeypatch):
    monkeypatch.chdir(walk.parent)
    block = _python_of_the_readme("Your own sampler in 20 lines")
    assert len([line for line in block.splitlines() if line]) <= 20
    few = "chains, warm_up, draws = 2, 10, 10"
    names = {}
    exec(compile(re.sub(r"chains, warm_up, draws = .*", few, block), "README.md", "exec"), names)
    model, pose = names["model"], names["tree"]["posterior"]["pose"]
    assert pose.sizes == {"chain": 2, "draw": 10, "dof": len(model.body.dof_names)}
    low, high = model.body.skeleton.low, model.body.skeleton.high
    assert ((pose.values >= low) & (pose.values <= high)).all()
    # The chains start at the first pose and move.
    assert (pose.std("draw") > 0).all() and abs(pose.sel(dof="root_z").mean() - 0.87) < 0.1
    assert Path("nuts.png").stat().st_size > 1000


def _python_of_the_readme(heading: str) -> str:
    (block,) = blocks(sections(README)[heading], "python")
    return block


@pytest.mark.slow
def test_every_key_of_the_summary_is_explained(walked):
    summary = json.loads((walked / "walk_run" / "summary.json").read_text())
    assert keys(sections(FIRST_RUN)["What is in the run's folder"]) == set(summary)


def test_every_option_of_the_command_line_is_explained(capsys):
    with pytest.raises(SystemExit):
        main(["track", "--help"])
    shown = set(re.findall(r"--[\w-]+", capsys.readouterr().out)) - {"--help"}
    assert keys(sections(FIRST_RUN)["Track"]) == shown


TERMS: list[tuple[Room, str, str]] = [
    ("dynamics", "dynamics", '`[dynamics] kind = "{}"`'),
    ("likelihood", "likelihood", '`[[likelihood]] kind = "{}"`'),
    ("observation", "observation", "`[likelihood.observation]` of `{}`"),
    ("potential", "constraint", '`[[constraint]] kind = "{}"`'),
    ("kernel", "kernel", '`[kernel] kind = "{}"`'),
]
# Terms of the room "potential" may be written under either name; the guide writes those of joints and parts as potentials.
POTENTIALS = ("kinematic", "penetration")
DOCUMENTED = [
    (room, name, (heading.replace("constraint", "potential") if name in POTENTIALS else heading).format(name))
    for room, _, heading in TERMS
    for name in names(room)
]


@pytest.mark.parametrize(("room", "name", "heading"), DOCUMENTED, ids=[f"{room}-{name}" for room, name, _ in DOCUMENTED])
def test_every_option_of_every_term_is_explained_with_its_default(room, name, heading):
    table = sections(DEFINITIONS)[heading]
    options = find(room, name).options.model_fields
    assert keys(table) == set(options)
    for key, field in options.items():
        (row,) = [line for line in table.splitlines() if line.startswith(f"| `{key}`")]
        default = row.split("|")[2].strip().strip("`")
        if field.is_required():
            assert default == "required", key
            continue
        expected = field.get_default(call_default_factory=True)
        if isinstance(expected, tuple):
            # Of a table with defaults only, nothing needs to be written.
            expected = [each.model_dump(exclude_unset=True) if isinstance(each, BaseModel) else each for each in expected]
        if expected is None:
            assert default == "none", key
            continue
        written = {"none": {}, "true": True}.get(default)
        assert (written if written is not None else _value(default)) == expected, key


def _value(text: str) -> object:
    return tomllib.loads(f"value = {text}")["value"]


@pytest.mark.parametrize(
    ("heading", "table"),
    [
        ("The body itself", schema.BodySchema),
        ("`[[joint]]`", tables.Joint),
        ("A dof", tables.Dof),
        ("`[[part]]`", tables.Part),
        ("`[clinical]`", tables.Segment),
        ("`[[likelihood.scale]]`", Scale),
        ("`[[potential.component]]`", Component),
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

    functions = set(bb.__all__) - {"compare", "kernels", "metrics", "posterior"}
    assert {name for name in functions if not callable(getattr(bb, name))} == set()
