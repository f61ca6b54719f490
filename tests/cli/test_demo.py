"""The demonstration, whole but small: it leaves what it says, finds the person, and refuses a folder that is taken."""

import contextlib
import io
import json
import re
from pathlib import Path

import pytest
import xarray

from bayes_body.cli.demo import has_display
from bayes_body.cli.main import main
from bayes_body.runs.demo import result_of

SUMMARY = {"frames": 60, "frames_lost": 0, "error_mm_mean": 47.6, "coverage_90": 0.91, "marker_disagreement_mm": 8.2}


def test_the_result_is_one_sentence():
    said = "60 frames tracked, none lost; the mean markers are 48 mm from the truth, and 91 % of it is inside the 90 % intervals (about right); "
    assert result_of(SUMMARY) == said + "the means of the two runs are 8 mm apart."
    assert "2 lost" in result_of(SUMMARY | {"frames_lost": 2})
    assert "(too narrow)" in result_of(SUMMARY | {"coverage_90": 0.5})


def test_a_demonstration_is_quick_or_long(cli):
    cli("demo", "--quick", "--long").refuses("--quick: given with --long; expected one of the two; leave one out")


@pytest.mark.parametrize(
    ("terminal", "variables", "shown"),
    [(True, {"DISPLAY": ":0"}, True), (False, {"DISPLAY": ":0"}, False), (True, {}, False), (True, {"DISPLAY": ":0", "SSH_CONNECTION": "a"}, False)],
)
def test_the_report_opens_where_somebody_sits_before_a_desktop(monkeypatch, terminal, variables, shown):
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "CI", "SSH_CONNECTION"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setattr("sys.stdout.isatty", lambda: terminal, raising=False)
    assert has_display() is shown


def test_git_ignores_its_folder():
    assert "bayes_body_demo*/" in (Path(__file__).parents[2] / ".gitignore").read_text(encoding="utf-8").splitlines()


@pytest.fixture(scope="module")
def demonstrated(tmp_path_factory, optimised):
    folder = tmp_path_factory.mktemp("demo")
    printed = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(printed):
        patch.chdir(folder)
        with pytest.raises(SystemExit) as stopped:
            main(["demo", "--quick"])
    assert stopped.value.code == 0
    (folder / "printed.txt").write_text(printed.getvalue(), encoding="utf-8")
    return folder / "bayes_body_demo"


@pytest.mark.long
def test_its_first_verdict_is_a_result_and_two_runs_made_it(demonstrated):
    lines = (demonstrated.parent / "printed.txt").read_text(encoding="utf-8").splitlines()
    assert [line.split()[0] for line in lines[:3]] == ["filmed", "tracking", "result"]
    assert re.match(r"result     12 frames tracked, none lost; the mean markers are \d+ mm from the truth, and \d+ % of it is inside", lines[2])
    assert "a single run" not in "\n".join(lines)
    with xarray.open_datatree(demonstrated / "run" / "posterior.nc") as tree:
        assert tree["posterior"]["pose"].sizes["chain"] == 2


@pytest.mark.long
def test_its_body_stays_on_the_person(demonstrated):
    summary = json.loads((demonstrated / "run" / "summary.json").read_text())
    assert summary["fit_first"] > 0.8 and summary["fit_worst"] > 0.75 and summary["frames_off"] == []


@pytest.mark.long
def test_it_leaves_what_it_says(demonstrated):
    for name in ("recording/session.toml", "recording/truth.npz", "run/overlay.mp4", "run/report.html", "run/posterior.nc", "run/summary.json"):
        assert (demonstrated / name).stat().st_size > 0
    with xarray.open_datatree(demonstrated / "run" / "posterior.nc") as tree:
        assert tree["posterior"]["pose"].sizes["frame"] == 12


@pytest.mark.long
def test_it_finds_the_person(demonstrated):
    summary = json.loads((demonstrated / "run" / "summary.json").read_text())
    assert summary["frames_lost"] == 0
    assert summary["error_mm_mean"] <= 80
    assert summary["iou_median"] >= 0.7
    assert 0 < summary["coverage_90"] <= 1


@pytest.mark.long
def test_a_folder_that_is_taken_is_refused(demonstrated, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["demo", "--quick", "--out", str(demonstrated)])
    assert stopped.value.code == 2
    assert "already holds a demonstration" in capsys.readouterr().err
