"""The guide's page on recordings, held against the program: its session loads, its tables are whole, its truth is read."""

import re
from pathlib import Path

import pytest

from bayes_body.cli.import_ import app
from bayes_body.recording.readers.keypoints.openpose import LAYOUTS
from bayes_body.recording.readers.truth import read_truth
from bayes_body.recording.session.read import load_session
from bayes_body.recording.session.schema import CameraTable, InitialTable, SegmentationTable, SessionFile, SubjectTable

PAGE = (Path(__file__).parents[3] / "docs" / "guide" / "recordings.md").read_text(encoding="utf-8")


def block(language: str) -> str:
    (text,) = re.findall(rf"^```{language}\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    return text


def keys(heading: str) -> dict[str, str]:
    """The table below a heading: key -> what it is."""
    section = re.search(rf"^##+ {re.escape(heading)}$(.*?)(^#|\Z)", PAGE, re.MULTILINE | re.DOTALL)
    assert section is not None
    return dict(re.findall(r"^\| `([^`]+)` \| (.*) \|$", section[1], re.MULTILINE))


TABLES = {
    "The recording": (SessionFile, {"camera", "subject", "initial", "segmentation"}),
    "`[[camera]]`, one for each": (CameraTable, set()),
    "`[subject]`": (SubjectTable, set()),
    "`[initial]`": (InitialTable, set()),
    "`[segmentation]`": (SegmentationTable, set()),
}


@pytest.mark.parametrize("heading", TABLES)
def test_every_key_is_told(heading):
    schema, tables = TABLES[heading]
    told, fields = keys(heading), {field.alias or name: field for name, field in schema.model_fields.items()}
    assert set(told) == set(fields) - tables
    assert {key for key, text in told.items() if text.startswith("*required*")} == {key for key in told if fields[key].is_required()}


def test_the_session_loads(tmp_path):
    (tmp_path / "session.toml").write_text(block("toml"))
    session = load_session(tmp_path)
    assert [view.camera.name for view in session.views] == ["left", "right"]


def test_the_truth_is_read(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(block("python"), "recordings.md", "exec"), {})
    assert read_truth(tmp_path / "truth.npz", 240).shape == (240, 15, 3)


def test_every_option_and_layout_is_told():
    from typer.main import get_command

    command = get_command(app)
    options = {name for verb in command.commands.values() for parameter in verb.params for name in parameter.opts if name.startswith("--")}
    assert set(keys("From your files to a session")) == options - {"--help"}
    assert all(f"`{layout}`" in PAGE for layout in LAYOUTS)
    assert all(f"bayes-body import {verb} " in PAGE for verb in command.commands)
