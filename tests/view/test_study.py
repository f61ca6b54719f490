"""The page and the table of a study: what a row says, what a browser sorts and filters, and that no text of a file becomes markup."""

import csv
import json
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import pytest
from browser import tab  # noqa: F401

from bayes_body.view.colours import person_ink
from bayes_body.view.study.page import page, write_index
from bayes_body.view.study.rows import Link, StudyRow, links_of, people_links_of, read_summary, row_of, write_csv

SUMMARY = {
    "frames": 300,
    "frames_lost": 2,
    "rhat_max": 1.0625,
    "coverage_90": 0.875,
    "error_mm_mean": 31.25,
    "seconds_total": 90.0,
    "seconds_per_frame": 0.25,
    "warnings": ["the first.", "the second."],
}


class Elements(HTMLParser):
    """All elements of a page: their names and attributes, and its text."""

    def __init__(self, text):
        super().__init__()
        self.elements, self.words = [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))

    def handle_data(self, data):
        self.words.append(data)


def test_a_row_has_the_figures_of_the_summary_and_links_to_what_exists(tmp_path):
    together, runs = tmp_path / "walk" / "all_runs", [tmp_path / "walk" / f"run_{number}" for number in (1, 2)]
    for folder in (together, *runs):
        folder.mkdir(parents=True)
    for file in (together / "report.html", runs[1] / "report.html", runs[1] / "view.html"):
        file.write_text("")
    row = row_of("walk", "fast", SUMMARY, together, "done", tmp_path, runs=runs, picture=tmp_path / "walk" / "none.jpg")
    expected = {"frames": 300, "frames_lost": 2, "rhat": 1.0625, "coverage_90": 0.875, "error_mm": 31.25, "seconds": 90.0, "warnings": 2}
    assert {name: getattr(row, name) for name in expected} == expected and row.warning == "the first." and row.picture == ""
    assert row.links == (
        Link("report", "walk/all_runs/report.html"),
        Link("run 2", "walk/run_2/report.html"),
        Link("run 2 in 3D", "walk/run_2/view.html"),
    )
    # A single run is the one that is shown.
    assert links_of(runs[1], runs[1:], tmp_path) == (Link("report", "walk/run_2/report.html"), Link("3D", "walk/run_2/view.html"))
    waiting = row_of("walk", "", read_summary(together), together, "waiting", tmp_path)
    assert waiting.warnings is None and waiting.rhat is None and waiting.seconds is None
    # Somebody's own file of that name.
    (together / "summary.json").write_text('["frames"]')
    assert read_summary(together) == {}
    assert row_of("walk", "", {"frames": "many", "rhat_max": True, "warnings": 3}, together, "done", tmp_path).frames is None


def test_the_table_has_plain_numbers(tmp_path):
    rows = [row_of('walk "1", fast', "", SUMMARY, tmp_path, "done", tmp_path), StudyRow("run", state="failed", note="no such\nfile.")]
    write_csv(rows, tmp_path / "study.csv")
    with (tmp_path / "study.csv").open(newline="") as file:
        first, second = csv.DictReader(file)
    assert (first["session"], first["rhat_max"], first["seconds"], first["coverage_90"]) == ('walk "1", fast', "1.0625", "90", "0.875")
    assert (second["state"], second["note"], second["rhat_max"], second["frames"]) == ("failed", "no such\nfile.", "", "")


@pytest.mark.parametrize("name", ["<script>alert(1)</script>", '"><img src=x onerror=alert(1)>', "javascript:alert(1)", "a b#c?d%e", "a'b&amp;c"])
def test_no_text_becomes_markup(name):
    row = StudyRow(name, name, "running", name, f"{name}/p.jpg", warnings=1, warning=name, links=(Link(name, f"{name}/report.html"),))
    elements = Elements(page([row], [(name, name)], name))
    usual = Elements(page([row._replace(session="a")], [], "a")).elements
    assert {tag for tag, _ in elements.elements} == {tag for tag, _ in usual} | {"ul", "li", "details", "summary"}
    attributes = [attribute for _, attributes in elements.elements for attribute in attributes]
    assert not [attribute for attribute in attributes if attribute.startswith("on")]
    addresses = [attributes["href"] for tag, attributes in elements.elements if tag == "a"]
    assert addresses and all(address.startswith("./") and unquote(address) == f"./{name}/report.html" for address in addresses)
    # Title, heading, session, variant, note, warning, two links, and twice in the list of failures.
    assert sum(word == name or word == f": {name}" for word in elements.words) == 9


def test_people_of_one_recording_have_their_colours_and_pages_together(tmp_path):
    rows = [StudyRow("walk_person_1"), StudyRow("walk_person_2"), StudyRow("jump")]
    (tmp_path / "people.html").write_text("")
    elements = Elements(write_index(rows, [], tmp_path, "study").read_text(encoding="utf-8"))
    styles = [attributes["style"] for tag, attributes in elements.elements if tag == "span" and "style" in attributes]
    assert styles == [f"color: {person_ink(number)}" for number in (1, 2)] and "person" in elements.words
    assert [attributes["href"] for tag, attributes in elements.elements if tag == "a"] == ["./people.html"]
    # Of several recordings there is a list, with who is missing; one without pages and without a remark is left out.
    (tmp_path / "walk").mkdir()
    (tmp_path / "walk" / "people_3d.html").write_text("")
    recordings = [
        people_links_of(name, tmp_path / name, tmp_path, remark) for name, remark in (("walk", "without <2>"), ("run", "none"), ("hop", ""))
    ]
    several = Elements(page(rows, [], "study", people=recordings))
    assert [attributes["href"] for tag, attributes in several.elements if tag == "a"] == ["./walk/people_3d.html"]
    assert {"All people of 2 recordings", ", without <2>", "run", ": none"} <= set(several.words) and "hop" not in several.words
    # Without people: nothing about them.
    alone = Elements(page(rows[2:], [], "study"))
    assert "person" not in alone.words and not [tag for tag, _ in alone.elements if tag == "a"]


def many(count):
    """Rows of a large study, each with ten runs that have a report."""
    for number in range(count):
        name = f"patient_{number:04d}_walking_trial_{number % 7}"
        warnings = ["frames 1-3: 27 effective particles of 1000 at worst, at frame 2 (limit 50); raise --particles, or use --kernel tempered.", "b"]
        links = tuple(Link(f"run {run}", f"{name}/run_{run}/report.html") for run in range(1, 11))
        row = row_of(name, "", SUMMARY | {"rhat_max": 1 + number / 1000, "warnings": warnings}, Path(name), "done", Path())
        yield row._replace(picture=f"{name}/picture.jpg", links=links)


def test_a_page_of_a_thousand_sessions_is_small(tmp_path):
    failures = [(f"patient_{number:04d}/run_1", "session.toml: no such file; expected a session; check the path.") for number in range(100)]
    path = write_index(list(many(1000)), failures, tmp_path, "large", {"done": 9900, "failed": 100})
    assert path.stat().st_size < 2_000_000
    text = path.read_text(encoding="utf-8")
    assert "1,000 sessions; 10,000 units: 9,900 done, 0 waiting, 0 running, 100 failed." in text and text.count("<tr") == 1001
    # No truth and no variants: no columns for them.
    unknown = page([StudyRow("a", state="running", note="4 of 9 frames")], [], "title")
    assert "mm" not in Elements(unknown).words and "variant" not in Elements(unknown).words and "failed</summary>" not in unknown


@pytest.mark.slow
def test_a_browser_sorts_numbers_as_numbers_with_what_is_missing_last_and_filters(tmp_path, tab):  # noqa: F811
    figures = {"walk_2": 1.5, "walk_10": None, "Walk_1": 10.25, "jump_3": 2.0}
    rows = [StudyRow(name, "", "done" if rhat else "waiting", rhat=rhat, frames=7) for name, rhat in figures.items()]
    opened = tab(write_index(rows, [], tmp_path, "study"))
    opened.until("document.readyState === 'complete'")
    names = "JSON.stringify(Array.from(document.querySelectorAll('tbody tr')).filter(r => !r.hidden).map(r => r.querySelector('b').textContent))"

    def shown(script):
        return json.loads(opened.value(f"{script}; {names}"))

    def click(heading):
        return f"Array.from(document.querySelectorAll('thead button')).find(b => b.textContent.startsWith('{heading}')).click()"

    assert shown("0") == list(figures)
    assert shown(click("R\u2011hat")) == ["walk_2", "jump_3", "Walk_1", "walk_10"]
    assert shown(click("R\u2011hat")) == ["Walk_1", "jump_3", "walk_2", "walk_10"]
    assert shown(click("session")) == ["jump_3", "Walk_1", "walk_2", "walk_10"]
    # Of equal frames: the order of the study.
    assert shown(click("frames")) == list(figures)
    typed = "const f = document.querySelector('input'); f.value = 'WALK done'; f.dispatchEvent(new Event('input'))"
    assert shown(f"(() => {{ {typed} }})()") == ["walk_2", "Walk_1"]
    assert opened.value("document.getElementById('shown').textContent") == "2 of 4 rows"
    assert shown("document.querySelector('button[data-state=waiting]').click()") == []
    assert opened.faults() == []


def test_the_driver_of_a_study_loads_neither_jax_nor_pictures():
    code = (
        "import sys; import bayes_body.view.study.page, bayes_body.view.study.thumbnail; print({'jax', 'numpy', 'cv2', 'xarray'} & set(sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "set()\n"
