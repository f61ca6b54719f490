"""Several people in one file and in a file each, read by readers of other projects."""

import ezc3d
import numpy as np
import pandas as pd
import pytest
from bench.foreign_readers import c3d_points
from people_runs import person_run

from bayes_body.base.errors import InputError
from bayes_body.cli.main import main
from bayes_body.results.storage.saved_moments import marker_moments
from bayes_body.results.storage.saved_run import load_run
from bayes_body.view.export.people import export_people
from bayes_body.view.people import open_people

MARKERS = ("l_shoulder", "l_elbow", "l_wrist")


@pytest.fixture
def runs(make_run, tmp_path):
    """The runs of two arms: one in the frames 10 to 12 of the recording, the other in 12 to 14."""
    run = make_run()
    return [person_run(run, tmp_path / "study", number, frames, first=10) for number, frames in ((1, range(3)), (2, range(2, 5)))]


@pytest.fixture
def expected(runs):
    """Millimetres of the mean markers of both over all frames; NaN where their person is not there."""
    points = np.full((5, 6, 3), np.nan)
    for place, (run, frames) in enumerate(zip(runs, (slice(3), slice(2, 5)), strict=True)):
        with load_run(run) as saved:
            points[frames, 3 * place : 3 * place + 3] = 1000 * marker_moments(saved).mean
    return points


def test_all_in_one_file(runs, expected, tmp_path, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["export", *map(str, runs), "--to", "trc,c3d", "--together", "--out", str(tmp_path / "all")])
    assert stopped.value.code == 0 and "6 markers of 2 people, 5 frames, z up" in capsys.readouterr().out
    labels = [f"person_{number}:{marker}" for number in (1, 2) for marker in MARKERS]
    lines = (tmp_path / "all.trc").read_text(encoding="utf-8").splitlines()
    assert [name for name in lines[3].split("\t")[2:] if name] == labels and lines[2].split("\t")[2:4] == ["5", "6"]
    # The frame of the recording with which the file begins, counted from 1.
    assert lines[2].split("\t")[6] == "11"
    rows = pd.read_csv(tmp_path / "all.trc", sep="\t", skiprows=4).iloc[:, 2:].to_numpy().reshape(5, 6, 3)
    c3d = ezc3d.c3d(str(tmp_path / "all.c3d"))
    assert c3d["parameters"]["POINT"]["LABELS"]["value"] == labels
    for points in (rows, c3d["data"]["points"][:3].transpose(2, 1, 0)):
        assert np.array_equal(np.isnan(points), np.isnan(expected)) and np.nanmax(np.abs(points - expected)) < 1.1e-3
    _, points, _ = c3d_points(tmp_path / "all.c3d")
    assert np.array_equal(points[..., 3] == -1, np.isnan(expected).any(axis=-1))


def test_a_file_each(runs, expected, tmp_path):
    for options, folder, stem in (([], tmp_path / "study", "motion"), (["--out", str(tmp_path / "walk.trc")], tmp_path, "walk")):
        with pytest.raises(SystemExit) as stopped:
            main(["export", *map(str, runs), "--to", "trc", *options])
        assert stopped.value.code == 0
        for number, frames in ((1, slice(3)), (2, slice(2, 5))):
            path = folder / f"{stem}_person_{number}.trc"
            rows = pd.read_csv(path, sep="\t", skiprows=4).iloc[:, 2:].to_numpy().reshape(3, 3, 3)
            assert np.abs(rows - expected[frames, 3 * number - 3 : 3 * number]).max() < 1.1e-3
            # Without a prefix: the file's name tells the person.
            assert path.read_text(encoding="utf-8").splitlines()[3].split("\t")[2] == MARKERS[0]


def test_what_cannot_be_in_one_file(runs, tmp_path, capsys):
    for arguments, fault in (
        ([*map(str, runs), "--to", "c3d,bvh", "--together"], "--together: with --to bvh, of which a file holds one body"),
        ([str(runs[0]), "--to", "c3d", "--together"], "--together: with one run"),
    ):
        with pytest.raises(SystemExit) as stopped:
            main(["export", *arguments])
        assert stopped.value.code == 2 and fault in capsys.readouterr().err
    (tmp_path / "all.c3d").write_text("mine")
    with open_people(runs) as people, pytest.raises(InputError, match="already exists"):
        export_people(people, {"trc": tmp_path / "all.trc", "c3d": tmp_path / "all.c3d"})
    assert not (tmp_path / "all.trc").exists()
