"""The real recording, tracked as its users do: the man stays covered in all views, and independent runs agree."""

import json

import pytest

from bayes_body.cli.main import main


@pytest.mark.slow
def test_five_annealed_runs_cover_the_man_and_agree(bodytrack, tmp_path):
    walk, run = str(tmp_path / "walk"), str(tmp_path / "run")
    sizes = ["--particles", "1000", "--layers", "5", "--runs", "5"]
    for arguments in (["import", "parsec", str(bodytrack), walk], ["track", walk, "--kernel", "annealed", *sizes, "--out", run]):
        with pytest.raises(SystemExit) as stopped:
            main(arguments)
        assert stopped.value.code == 0
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["frames"] == 4
    assert summary["frames_lost"] == 0
    assert summary["iou_median"] >= 0.66
    assert summary["marker_disagreement_mm"] <= 40
    assert summary["log_evidence"] is None
    assert summary["peak_memory_mb"] < 2000
