"""The pages of the papers: every row is whole and drawn, and values are stored case by case. With `--quick`, every program measures all its rows."""

import json
import re
from importlib import import_module
from pathlib import Path

import paper_page
import pytest
import reproduce
from paper_page import PAPERS, STORED, load_page, page_text
from paper_tables import here, number, with_paper_tables

# The figures and tables that each paper has.
CONTENTS = {"poon_fleet_2002": (9, 0), "sidenbladh_2000": (7, 0), "darby_2008": (3, 0), "sigal_2011": (16, 5)}
TINY = """
paper = "tiny"
title = "Tiny"
[[row]]
name = "mean"
where = "Table 1"
claim = "The mean is 2."
[[row.figure]]
name = "mean"
unit = "mm"
paper = "2"
[[row]]
name = "drawing"
where = "Fig. 1"
claim = "A body."
reason = "A drawing."
"""


def labels_of(where: str) -> set[tuple[str, int]]:
    """The figures and tables that a text names: `Table 3, Fig. 8 and 11`."""
    groups = re.findall(r"(Fig|Table)[s.]* ((?:\d+(?:\([a-z]\))?(?:, | and )?)+)", where)
    return {(kind, int(number)) for kind, numbers in groups for number in re.findall(r"\d+", numbers)}


@pytest.fixture(params=CONTENTS)
def paper(request) -> str:
    return request.param


def test_the_stored_page_has_the_claims_as_they_are(paper):
    path = STORED / f"{paper}.json"
    assert path.read_text(encoding="utf-8") == page_text(load_page(paper, path)), f"run `python inference/papers/{paper}.py`"


def test_every_row_is_whole(paper):
    page = load_page(paper, STORED / f"{paper}.json")
    measured_here = {name for experiment in import_module(paper).EXPERIMENTS for name in experiment.rows}
    assert len({row.name for row in page.rows}) == len(page.rows)
    figures, tables = CONTENTS[paper]
    labels = {label for row in page.rows for label in labels_of(row.where)}
    assert labels == {("Fig", number) for number in range(1, figures + 1)} | {("Table", number) for number in range(1, tables + 1)}
    for row in page.rows:
        assert row.where and row.claim.endswith(".") and bool(row.reason) != bool(row.command), row.name
        assert (f"inference/papers/{paper}.py" in row.command) == (row.name in measured_here), row.name
        if row.reason:
            assert not row.figures, row.name
            continue
        assert row.figures and (not row.date or (STORED / row.picture).exists()), row.name
        assert bool(row.earlier) == any(figure.earlier for figure in row.figures), row.name
        for figure in row.figures:
            assert not figure.values or (row.settings is not None and row.date and row.versions), row.name
            assert all((value.subject is None) == (value.seed is None) for value in figure.values), row.name


def test_the_page_shows_every_row(paper):
    text = (STORED.parent / f"{paper}.md").read_text(encoding="utf-8")
    drawn = with_paper_tables(text, STORED)
    assert "<!--" not in drawn
    head, tail = drawn.split("</table>")
    for row in json.loads((STORED / f"{paper}.json").read_text(encoding="utf-8"))["rows"]:
        anchor = f"#row-{row['name'].replace('_', '-')}"
        assert head.count(f"[{row['where']}]({anchor})") == 1 and tail.count(f"{{ {anchor} }}") == 1
        assert row["claim"] in head and row["differs"] in head and row["reason"] in head and row["command"] in tail
        for figure in row["figures"] or [{}]:
            assert f'">{here(row, figure)}</td></tr>' in head and f'">{figure.get("name", "")}</td>' in head


def test_what_a_table_says_of_a_figure():
    values = [{"subject": "38_02", "seed": seed, "value": value} for seed, value in enumerate((62.04, 30.0, 95.0))]
    figure = {"unit": "mm", "earlier": "70", "values": values, "median": 62.04, "lowest": 30.0, "highest": 95.0}
    assert here({"status": "measured"}, figure) == "**62** (30 to 95) mm"
    assert here({"status": "measured earlier"}, figure | {"values": []}) == "70 mm (earlier)"
    assert here({"status": "not measured yet"}, {"unit": "mm", "values": []}) == "not measured yet"
    assert here({"status": "not reproduced"}, {}) == "not measured"
    assert [number(value) for value in (0, 0.00012345, 0.12345, 1234.5, 12.0, 1.0012)] == ["0", "0.000123", "0.123", "1234", "12", "1.001"]


@pytest.fixture
def tiny(tmp_path, monkeypatch):
    """Run the program of a paper with two rows; `tiny(measure, "--all")` returns its page."""
    (tmp_path / "tiny").mkdir()
    (tmp_path / "tiny" / "claims.toml").write_text(TINY)
    monkeypatch.setattr(paper_page, "PAPERS", tmp_path)

    def run(measure, *arguments, sizes=None):
        monkeypatch.setattr("sys.argv", ["tiny.py", "--work", str(tmp_path), "--json", str(tmp_path / "tiny.json"), *arguments])
        reproduce.reproduce("tiny", (reproduce.Experiment(("mean",), measure, sizes or {"frames": 3}),))
        return load_page("tiny", tmp_path / "tiny.json")

    return run


def test_cases_are_stored_one_by_one_and_measured_once(tiny, tmp_path, capsys):
    cases = []

    def measure(case):
        if len(cases) == 2:
            raise KeyboardInterrupt
        cases.append((case.subject, case.seed))
        return {"mean": {"mean": len(cases)}}

    with pytest.raises(KeyboardInterrupt):
        tiny(measure, "--all")
    stored = load_page("tiny", tmp_path / "tiny.json").row("mean")
    assert [value.value for value in stored.figures[0].values] == [1, 2] and stored.status == "measured in part"
    page = tiny(lambda case: {"mean": {"mean": 7.00004}}, "--rows", "mean")
    (figure,) = page.row("mean").figures
    assert [value.value for value in figure.values] == [1, 2, 7, 7] and page.row("mean").status == "measured"
    assert (figure.median, figure.lowest, figure.highest) == (4.5, 1, 7) and page.row("mean").settings == {"frames": 3}
    # Nothing is measured again with the same sizes; with others all is.
    assert tiny(measure, "--all") == page
    again = tiny(lambda case: {"mean": {"mean": None if case.seed else 5}}, "--all", sizes={"frames": 4}).row("mean")
    assert [(value.seed, value.value) for value in again.figures[0].values] == [(0, 5), (0, 5)] and again.settings == {"frames": 4}
    assert page.row("drawing").status == "not reproduced"
    capsys.readouterr()
    tiny(measure, "--list")
    assert re.findall(r"^(\w+) ", capsys.readouterr().out, re.MULTILINE) == ["mean", "drawing"]


def test_a_costly_experiment_takes_one_seed_for_a_subject_and_some_have_recordings_of_their_own():
    def cases(quick=False, **options):
        return list(reproduce.Experiment(("mean",), dict, **options).cases(quick, ["a", "b", "c"], [0, 1]))

    assert cases() == [("a", 0), ("a", 1), ("b", 0), ("b", 1), ("c", 0), ("c", 1)]
    assert cases(costly=True) == [("a", 0), ("b", 1), ("c", 0)] and cases(True, costly=True) == [("a", 0)]
    assert cases(pairs=[("d", 7), ("e", 8)]) == [("d", 7), ("e", 8)] and cases(facts=True) == [(None, None)]


def test_wrong_arguments_are_sentences(tiny, tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("BAYES_BODY_DATA", raising=False)
    for arguments, part in (
        (["--rows", "drawing"], "--rows: drawing; expected rows that this program measures: mean"),
        (["--all"], "--motions: not given; expected a folder with walks of the CMU database"),
    ):
        with pytest.raises(SystemExit) as stopped:
            tiny(lambda case: {"mean": {"mean": len(case.motion.name)}}, *arguments)
        assert stopped.value.code == 2 and part in capsys.readouterr().err
    (tmp_path / "tiny.json").write_text("{")
    with pytest.raises(SystemExit):
        tiny(lambda case: {}, "--all")
    assert "expected a page that this program wrote" in capsys.readouterr().err


@pytest.mark.long
@pytest.mark.usefixtures("optimised")
def test_quick(paper, program_runner, cmu_mocap, tmp_path):
    """Every row of the program has a value for one subject and one seed, and the pictures are there."""
    path = tmp_path / f"{paper}.json"
    done = program_runner(PAPERS / f"{paper}.py", "--all", "--quick", "--motions", cmu_mocap, "--work", tmp_path, "--json", path)
    assert done.status == 0, done.err
    page = load_page(paper, path)
    for name in [name for experiment in import_module(paper).EXPERIMENTS for name in experiment.rows]:
        row = page.row(name)
        assert any(figure.values for figure in row.figures), name
        assert not row.picture or (Path(tmp_path) / row.picture).stat().st_size > 1000, name
