"""`bayes-body benchmark`: rows in a file and in a table, sentences why not, and what is wrong with its input."""

import json
import re
from pathlib import Path

import pytest
from own_terms import GOOD, MODEL, plugins_of_this_test

from bayes_body.cli.main import main

GUIDE = (Path(__file__).parents[2] / "docs" / "guide" / "benchmark.md").read_text(encoding="utf-8")
SMALL = ["--quick", "--frames", 2, "--kernel", "sir"]


def test_rows_in_the_file_and_in_the_table(cli, tmp_path):
    command = ["benchmark", *SMALL, "--model", "arm_markers", "--model", "arm", "--json", tmp_path / "rows.json"]
    outcome = cli(*command)
    assert outcome.status == 0, outcome.err
    rows = json.loads((tmp_path / "rows.json").read_text())["rows"]
    assert [(row["model"], row["kernel"], row["why_not"] is None) for row in rows] == [("arm_markers", "sir", True), ("arm", "sir", False)]
    (line,) = [line for line in outcome.out.splitlines() if line.startswith("arm_markers")]
    assert line.split()[:3] == ["arm_markers", "sir", "drawn"] and f"{rows[0]['error_mm_mean']:.0f}" in line.split()
    assert f"arm × sir: {rows[1]['why_not']}" in outcome.out.splitlines()
    # Every key is explained.
    explained = {key for line in GUIDE.splitlines() if line.startswith("| `") for key in re.findall(r"`([^`]*)`", line.split("|")[1])}
    assert set(rows[0]) <= explained
    assert cli(*command).status == 0
    again = json.loads((tmp_path / "rows.json").read_text())["rows"]
    assert again == rows


def test_every_option_is_explained(capsys):
    with pytest.raises(SystemExit):
        main(["benchmark", "--help"])
    shown = set(re.findall(r"--[\w-]+", capsys.readouterr().out)) - {"--help"}
    assert shown <= set(re.findall(r"^\| `(--[\w-]+)`", GUIDE, re.MULTILINE))


def test_a_plugin_s_model_is_tried(cli, tmp_path, textured_session):
    from bayes_body.recording.session.read import save_session

    save_session(textured_session)
    (tmp_path / "mine.py").write_text(GOOD, encoding="utf-8")
    (tmp_path / "mine.toml").write_text(MODEL, encoding="utf-8")
    command = ["benchmark", *SMALL, "--model", tmp_path / "mine.toml", "--session", textured_session.folder]
    outcome = cli(*command)
    assert outcome.status == 0 and "mine × sir: " in outcome.out and "'brightness' does not exist" in outcome.out
    with plugins_of_this_test():
        outcome = cli(*command, "--plugin", tmp_path / "mine.py")
    assert outcome.status == 0 and "recording" in outcome.out, outcome.out


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["--kernel", "sirr"], ["kernel 'sirr' does not exist", "did you mean 'sir'?"]),
        (["--frames", "0"], ["--frames: 0", "a whole number from 1 up"]),
        (["--session", "nowhere"], ["nowhere", "no such file"]),
        (["--plugin", "nowhere.py"], ["nowhere.py: no such file"]),
    ],
)
def test_input_that_cannot_be_used(cli, arguments, parts):
    cli("benchmark", *arguments).refuses(*parts)


@pytest.mark.parametrize("text", ["", "{}", "[1, 2]", '{"rows": [1]}', '{"rows": [{"model": "arm"}]}'])
def test_a_file_that_is_not_ours_is_left_as_it_is(cli, tmp_path, text):
    (tmp_path / "rows.json").write_text(text)
    cli("benchmark", *SMALL, "--model", "arm", "--json", tmp_path / "rows.json").refuses("rows.json", "cannot be read", "another file with --json")
    assert (tmp_path / "rows.json").read_text() == text
