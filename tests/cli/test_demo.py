"""The demonstration, whole but small: it leaves what it says, finds the person, and refuses a folder that is taken."""

import json

import pytest
import xarray

from bayes_body.cli.main import main

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("optimised")]


@pytest.fixture(scope="module")
def demonstrated(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        with pytest.raises(SystemExit) as stopped:
            main(["demo", "--quick"])
    assert stopped.value.code == 0
    return folder / "bayes_body_demo"


def test_it_leaves_what_it_says(demonstrated):
    for name in ("recording/session.toml", "recording/truth.npz", "run/overlay.mp4", "run/report.html", "run/posterior.nc", "run/summary.json"):
        assert (demonstrated / name).stat().st_size > 0
    with xarray.open_datatree(demonstrated / "run" / "posterior.nc") as tree:
        assert tree["posterior"]["pose"].sizes["frame"] == 12


def test_it_finds_the_person(demonstrated):
    summary = json.loads((demonstrated / "run" / "summary.json").read_text())
    assert summary["frames_lost"] == 0
    assert summary["error_mm_mean"] <= 80
    assert summary["iou_median"] >= 0.7
    assert 0 < summary["coverage_90"] <= 1


def test_a_folder_that_is_taken_is_refused(demonstrated, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["demo", "--quick", "--out", str(demonstrated)])
    assert stopped.value.code == 2
    assert "holds a demonstration already" in capsys.readouterr().err
