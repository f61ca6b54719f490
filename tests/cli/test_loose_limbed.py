"""A whole run of a loose-limbed body at the command line: tracked, continued, reported and exported."""

import json

import numpy as np
import pytest
import xarray as xr
from shared_fixtures import loose_limbed

from bayes_body.model.definition import load_definition
from bayes_body.recording.session.read import save_session
from bayes_body.results.storage.saved_run import load_run


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """The arm and its markers, with an upper arm and a forearm of unknown lengths, which the elbow keeps together."""
    path = tmp_path_factory.mktemp("model") / "loose_arm.toml"
    text = loose_limbed(load_definition("arm_markers").text)
    text = text.replace("[[likelihood]]", '[[potential]]\nkind = "kinematic"\n\n[[likelihood]]', 1).replace('kind = "sir"', 'kind = "tempered"')
    text = text.replace("[kernel]", '[[unknown]]\nkind = "lengths"\n\n[kernel]', 1)
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.slow
def test_from_track_to_export(cli, model, keypoint_session, tmp_path):
    save_session(keypoint_session)
    run, whole = tmp_path / "run", tmp_path / "whole"
    assert cli("models", "check", model).status == 0
    options = ("track", keypoint_session.folder, "--model", model, "--particles", "40", "--runs", "2", "--seed", "3")
    for out, frames in ((run, "2"), (whole, "3")):
        outcome = cli(*options, "--frames", frames, "--out", out)
        assert outcome.status == 0, outcome.err
    outcome = cli("track", keypoint_session.folder, "--frames", "3", "--out", run, "--resume")
    assert outcome.status == 0, outcome.err
    with xr.open_datatree(run / "posterior.nc", engine="h5netcdf") as own, xr.open_datatree(whole / "posterior.nc", engine="h5netcdf") as other:
        assert own["posterior"]["parts"].dims == ("chain", "draw", "frame", "part", "coordinate")
        assert np.array_equal(own["posterior"]["parts"], other["posterior"]["parts"])
        lengths = np.asarray(own["posterior"]["lengths"])
        quaternions = np.asarray(own["posterior"]["parts"])[..., 3:]
    assert np.abs(np.linalg.norm(quaternions, axis=-1) - 1).max() < 1e-4
    assert lengths.shape[-1] == 2 and (lengths.std(axis=(0, 1)) > 0).all()
    summary = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    assert [row["entry"] for row in summary["unknowns"]] == ["upper_arm", "forearm"]
    assert (summary["frames"], summary["dof"]) == (3, 12) and summary["rhat_max"] > 0 and summary["marker_disagreement_mm"] > 0

    assert cli("report", run).status == 0
    page = (run / "report.html").read_text(encoding="utf-8")
    assert "forearm ry" in page and "upper arm x" in page
    outcome = cli("view", run)
    assert outcome.status == 0 and (run / "view.html").stat().st_size > 800_000, outcome.err
    outcome = cli("picture", run, "--frame", 2, "--svg")
    assert outcome.status == 0 and "draws" in (run / "picture_a_000002.svg").read_text(encoding="utf-8"), outcome.err
    for name in ("trc", "c3d", "csv", "bvh", "npz"):
        outcome = cli("export", run, "--to", name)
        assert outcome.status == 0, outcome.err
        assert (run / f"motion.{name}").stat().st_size > 0
    with load_run(run) as saved, np.load(run / "motion.npz") as arrays:
        assert saved.model.body.variable == "parts" and arrays["marker_mean_m"].shape == (3, 3, 3)
        elbow = np.abs(arrays["marker_mean_m"][:, 1] - arrays["part_mean_m"][:, 1]).max()
    assert elbow < 1e-5


@pytest.mark.long
def test_message_passing_leaves_figures_that_a_resumed_run_repeats(cli, model, keypoint_session, tmp_path):
    save_session(keypoint_session)
    run, whole = tmp_path / "run", tmp_path / "whole"
    options = ("track", keypoint_session.folder, "--model", model, "--kernel", "particle_bp", "--particles", "40", "--seed", "3")
    settings = ("--set", "samples=30", "--set", "iterations=3", "--set", "annealing=0.9")
    for out, frames in ((run, "1"), (whole, "2")):
        outcome = cli(*options, *settings, "--frames", frames, "--out", out)
        assert outcome.status == 0, outcome.err
    outcome = cli("track", keypoint_session.folder, "--frames", "2", "--out", run, "--resume")
    assert outcome.status == 0, outcome.err
    with xr.open_datatree(run / "posterior.nc", engine="h5netcdf") as own, xr.open_datatree(whole / "posterior.nc", engine="h5netcdf") as other:
        assert own["filter"].identical(other["filter"]) and own["posterior"].identical(other["posterior"])
        assert own["filter"]["message_change"].dims == ("chain", "frame", "iteration", "part")
        assert np.allclose(own["filter"]["proposal_shares"].sum("proposal"), 1, atol=1e-4)
        least = float(own["filter"]["belief_ess"].min())
    summary = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    assert summary["belief_ess_min"] == pytest.approx(least) and 1 <= least <= 30
    assert summary["joint_ess_min"] >= 1 and summary["message_ess_min"] >= 1 and summary["message_change_last"] > 0
    assert cli("report", run).status == 0
    assert "<h2>Message passing</h2>" in (run / "report.html").read_text(encoding="utf-8")
