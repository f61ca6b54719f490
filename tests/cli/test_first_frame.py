"""`track --first-frame`: a run from a later frame on, and the numbers by which it, and all that reads it, name frames."""

import json
import tomllib
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from bayes_body.cli.main import main
from bayes_body.recording.session.read import save_session

FIRST, FRAMES = 2, 3


@pytest.fixture(scope="module")
def session(textured_session):
    save_session(textured_session)
    return textured_session.folder


@pytest.fixture
def track(cli, session):
    def call(out, *arguments):
        return cli("track", session, "--out", out, "--model", "arm", "--particles", 40, "--runs", 2, *arguments)

    return call


@pytest.fixture(scope="module")
def whole_run(tmp_path_factory, session):
    """A run from that frame on."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    with pytest.raises(SystemExit) as stopped:
        main(["track", str(session), "--out", str(folder), "--model", "arm", "--particles", "40", "--runs", "2", "--first-frame", str(FIRST)])
    assert stopped.value.code == 0
    return folder


def test_it_begins_there(track, tmp_path):
    run = tmp_path / "run"
    outcome = track(run, "--first-frame", FIRST, "--frames", 2, "--no-pictures")
    assert outcome.status == 0, outcome.err
    assert not list(run.glob("overlay*")) and "overlay.mp4" not in outcome.out
    assert tomllib.loads((run / "run.toml").read_text(encoding="utf-8"))["run"]["first_frame"] == FIRST
    assert json.loads((run / "summary.json").read_text(encoding="utf-8"))["first_frame"] == FIRST
    posterior = (run / "posterior.nc").read_bytes()
    assert track(run, "--resume").status == 0
    assert [path.name for path in sorted((run / "overlay").iterdir())] == ["frame_000002.png", "frame_000003.png"]
    assert (run / "overlay.mp4").is_file() and (run / "posterior.nc").read_bytes() == posterior


@pytest.mark.slow
def test_it_goes_on_from_there(track, tmp_path):
    run = tmp_path / "begun"
    assert track(run, "--first-frame", FIRST, "--frames", 2).status == 0
    track(run, "--resume", "--first-frame", 1).refuses("cannot be continued: --first-frame was 2 and is now 1", "change it back")
    track(run, "--resume", "--first-frame", 0).refuses("cannot be continued: --first-frame was 2 and is now not set")
    outcome = track(run, "--resume", "--frames", FRAMES)
    assert outcome.status == 0, outcome.err
    assert "continuing at frame 2 of 3, number 4 of the recording" in outcome.out
    whole = track(tmp_path / "run", "--first-frame", FIRST)
    assert whole.status == 0, whole.err
    with xr.open_datatree(run / "posterior.nc") as one, xr.open_datatree(tmp_path / "run" / "posterior.nc") as other:
        assert one["posterior"]["frame"].values.tolist() == [2, 3, 4]
        assert all(one[group].to_dataset().equals(other[group].to_dataset()) for group in ("posterior", "sample_stats", "filter"))


def test_its_frames_are_those_of_the_recording(whole_run, tmp_path, textured_session):
    """The same posterior as that of a session whose file begins there."""
    folder = tmp_path / "cut"
    views = tuple(
        replace(view, images=f"{textured_session.folder}/{view.images}", masks=f"{textured_session.folder}/{view.masks}")
        for view in textured_session.views
    )
    save_session(replace(textured_session, folder=folder, first_frame=FIRST, frames=FRAMES, views=views))
    with pytest.raises(SystemExit) as stopped:
        main(["track", str(folder), "--out", str(tmp_path / "run"), "--model", "arm", "--particles", "40", "--runs", "2"])
    assert stopped.value.code == 0
    with xr.open_datatree(whole_run / "posterior.nc") as one, xr.open_datatree(tmp_path / "run" / "posterior.nc") as other:
        assert one["posterior"].to_dataset().equals(other["posterior"].to_dataset())


@pytest.mark.slow
def test_what_reads_it_names_its_frames(cli, whole_run, tmp_path):
    outcome = cli("report", whole_run, "--out", tmp_path / "report.html")
    assert outcome.status == 0, outcome.err
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "Time is in seconds from frame 2" in page and "Posterior of frame" in page
    assert "--first-frame 2" in page and "Frame 4: the recording with the posterior" in page
    for before in ("frame 0", "Frame 0", "frame 1<", "frame 1."):
        assert before not in page
    assert cli("export", whole_run, "--to", "csv", "--out", tmp_path / "run.csv").status == 0
    table = np.genfromtxt(tmp_path / "run.csv", delimiter=",", names=True)
    assert table["frame"].tolist() == [2, 3, 4] and table["time_s"][0] == 0
    cli("view", whole_run, "--out", tmp_path / "view.html", "--frames", "0-1").refuses("--frames: 0-1; expected A-B with frames from 2 to 4")


@pytest.mark.slow
def test_a_smoothed_run_keeps_the_numbers(cli, whole_run):
    outcome = cli("smooth", whole_run, "--out", whole_run.parent / "smoothed", "--draws", 20, "--moves", 0, "--no-pictures")
    assert outcome.status == 0, outcome.err
    assert not list((whole_run.parent / "smoothed").glob("overlay*"))
    with xr.open_datatree(whole_run.parent / "smoothed" / "posterior.nc") as tree:
        assert tree["posterior"]["frame"].values.tolist() == [2, 3, 4]


def test_frames_that_are_not_there_are_refused(track, tmp_path):
    track(tmp_path / "run", "--first-frame", 5).refuses("--first-frame: 5; expected a frame of the recording, 0 to 4; give the number of one of")
    track(tmp_path / "run", "--first-frame", -1).refuses("--first-frame: -1; expected a frame of the recording, 0 to 4")
    track(tmp_path / "run", "--first-frame", 3, "--frames", 3).refuses("--frames: 3; expected a whole number from 1 to 2")
    assert not (tmp_path / "run").exists()
