"""inference/window.py on the run of a filter: an arm that swings, its markers seen by two cameras."""

import dataclasses
import json
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

import bayes_body as bb
from bayes_body.cli.main import main
from bayes_body.model.build import build_model
from bayes_body.model.definition import load_definition
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.readers.keypoints.series import KeypointSeries, write_series
from bayes_body.runs.run import run as track_run
from bayes_body.runs.settings import Settings
from bayes_body.runs.smooth import SmoothSettings, smooth_run

PROGRAM = Path(__file__).parents[2] / "inference" / "window.py"
FRAMES = 5
POSES = np.radians([-40.0, -30.0, 20.0, -60.0]) + 0.04 * np.arange(FRAMES)[:, None] * np.array([1.0, -1.0, 0.5, -1.0])


def quiet(line):
    """Show nothing."""


@pytest.fixture(scope="module")
def filtered(textured_session, tmp_path_factory):
    """The run of a particle filter, and the same run smoothed."""
    folder, rng = tmp_path_factory.mktemp("arm"), np.random.default_rng(0)
    model, views = build_model(load_definition("arm_markers"), textured_session), []
    points = jax.vmap(model.markers)(jnp.asarray(POSES, model.body.lengths.dtype))
    for number, view in enumerate(textured_session.views):
        pixels, _ = bb.project(jax.tree.map(lambda leaf, n=number: leaf[n], model.rig), points)
        keypoints = np.zeros((FRAMES, len(MARKERS), 3))
        places = [MARKERS.index(name) for name in model.body.markers.names]
        keypoints[:, places, :2], keypoints[:, places, 2] = pixels + rng.normal(0, 2, pixels.shape), 0.9
        path = folder / f"{view.camera.name}.npz"
        write_series(path, KeypointSeries(keypoints, MARKERS, 0))
        paths = {name: str(textured_session.folder / getattr(view, name)) for name in ("images", "masks")}
        views.append(dataclasses.replace(view, keypoints=str(path), **paths))
    session = dataclasses.replace(textured_session, folder=folder / "session", views=tuple(views))
    session.folder.mkdir()
    bb.save_session(session)
    track_run(Settings(session.folder, folder / "run", "arm_markers", "sir", {"particles": 500}, runs=2), quiet, bar=False)
    smooth_run(SmoothSettings(folder / "run", folder / "smoothed", {"draws": 40}), quiet, bar=False)
    return folder


@pytest.mark.long
@pytest.mark.usefixtures("optimised")
def test_error_bars_of_a_window(run, filtered, tmp_path):
    done = run(PROGRAM, "--run", filtered / "smoothed", "--out", tmp_path, "--quick")
    assert (done.status, done.err) == (0, "")
    assert re.search(r"^elbow +-\d+\.\d ± \d+\.\d +-\d+\.\d ± \d+\.\d +deg$", done.out, re.MULTILINE)
    chains = r"R-hat: \d\.\d{3} for the worst coordinate; the chains", r"effective draws: \d+ .*, of 200", r"divergences: (none|\d of 200)"
    for part in (*chains, "smoother's means lie", r"log-evidence of the window given the frames before it: -\d+\.\d\d ± 0\.\d\d nats"):
        assert re.search(part, done.out), part
    with xr.open_datatree(tmp_path / "posterior.nc") as tree:
        pose = tree["posterior"]["pose"]
        assert dict(pose.sizes) == {"chain": 2, "draw": 100, "frame": 2, "dof": 4} and pose.frame.values.tolist() == [3, 4]
        assert tree["sample_stats"]["diverging"].dims == ("chain", "draw") and set(pose.unit.values) == {"rad"}
        assert tree["smoothed"]["pose"].sizes["path"] == 80
        # The truth is not far from a posterior of half a degree to some degrees.
        assert (np.abs(pose.mean(("chain", "draw")) - POSES[3:]) < 5 * pose.std(("chain", "draw")) + 0.02).all()


@pytest.mark.long
@pytest.mark.usefixtures("optimised")
def test_models_are_compared_on_a_window(filtered, tmp_path, capsys):
    """The bridge and the filters estimate the same evidence: this model has no constraints, and its particles are many for four dofs."""
    wide, text = tmp_path / "wide.toml", load_definition("arm_markers").text
    wide.write_text(text.replace("= 3.0", "= 9.0").replace("= 4.0", "= 12.0"))
    for name, model in (("narrow", "arm_markers"), ("wide", str(wide))):
        track_run(Settings(filtered / "session", tmp_path / name, model, "sir", {"particles": 20_000}, runs=3), quiet, bar=False)
    with pytest.raises(SystemExit) as stopped:
        main(["compare", str(tmp_path / "narrow"), str(tmp_path / "wide"), "--window", "2-4", "--out", str(tmp_path / "out")])
    out = capsys.readouterr().out
    assert stopped.value.code == 0
    window = json.loads((tmp_path / "out" / "comparison.json").read_text())["window"]
    for row in window["models"]:
        assert row["rhat_max"] < 1.02 and row["log_evidence_error"] < 0.3
        # Three runs know their spread badly, and the prior of the window is one Gaussian.
        assert abs(row["log_evidence"] - row["filters"]) < 4 * np.hypot(row["log_evidence_error"], row["filters_sd"]) + 1, out
    assert "In frames 2-4, by bridge sampling, " in out and len(window["models"]) == 2


@pytest.mark.long
@pytest.mark.parametrize(
    ("arguments", "part"),
    [(("--first", "3", "--frames", "3"), "3 to 5; expected consecutive frames from 1 to 4"), (("--frames", "6"), "-1 to 4; expected")],
)
def test_a_window_outside_the_run_is_a_sentence(run, filtered, tmp_path, arguments, part):
    done = run(PROGRAM, "--run", filtered / "run", "--out", tmp_path / "window", *arguments)
    assert done.status == 2 and f"the frames of the window: {part}" in done.err.splitlines()[-1] and done.out == ""


@pytest.mark.parametrize(
    ("arguments", "part"), [(("--chains", "1"), "--chains: 1; expected"), (("--run", "nowhere"), "nowhere: no such folder")], ids=["chains", "run"]
)
def test_a_wrong_input_is_a_sentence(run, tmp_path, arguments, part):
    done = run(PROGRAM, "--run", ".", "--out", tmp_path / "window", *arguments)
    assert done.status == 2 and part in done.err.splitlines()[-1] and done.out == ""
