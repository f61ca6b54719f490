"""`bayes-body track`: what a run leaves behind, that it can be repeated from that alone, and sentences about wrong input."""

import dataclasses
import json
import subprocess
import sys
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest
import xarray as xr

from bayes_body.recording.session.read import save_session

from .conftest import PROGRESS

FRAMES, PARTICLES, LAYERS, RUNS, DOFS = 4, 100, 2, 2, 31
KEYS = {
    *("frames", "frames_lost", "frames_restarted", "cameras", "dof", "particles", "layers", "runs", "kernel", "model", "seed"),
    *("seconds_total", "seconds_compile", "seconds_per_frame", "evaluations_per_second", "peak_memory_mb", "frame_pairs"),
    *(
        "ess_min",
        "ess_median",
        "rhat_max",
        "iou_median",
        "reads",
        "reprojection_px_median",
        "fit_by",
        "fit_first",
        "fit_worst",
        "fit_worst_frame",
        "frames_off",
        "warnings",
    ),
}


@pytest.fixture(scope="module")
def run(walk, tmp_path_factory) -> Path:
    """The folder of one whole run, in a process of its own: its figures of time and memory are that of a user's."""
    out = tmp_path_factory.mktemp("runs") / "run"
    command = ["track", str(walk), "--out", str(out), "--particles", str(PARTICLES), "--layers", str(LAYERS), "--runs", str(RUNS), "--seed", "3"]
    command += ["--model", "deutscher_2005"]
    done = subprocess.run([sys.executable, "-m", "bayes_body.cli.main", *command], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    # Nobody looks at a terminal: standard error is a log of the progress, and nothing else.
    lines = [line[11:] for line in done.stderr.splitlines() if PROGRESS.match(line)]
    assert len(lines) == done.stderr.count("\n") and {"looking at the recording's files ...", "tracking: compiling"} <= set(lines)
    assert any(line.startswith(f"tracking: frame {FRAMES} of {FRAMES} (100 %)") for line in lines)
    assert "mode seeker" in done.stdout
    return out


@pytest.fixture
def again(cli, walk, tmp_path):
    """`again("--frames", 2)`: the posterior of the same run, anew, with other options."""

    def call(*arguments):
        options = ["--model", "deutscher_2005", "--particles", PARTICLES, "--layers", LAYERS, "--runs", RUNS, "--seed", 3]
        outcome = cli("track", walk, "--out", tmp_path / "again", *options, *arguments)
        assert outcome.status == 0, outcome.err
        return posterior(tmp_path / "again")

    return call


def posterior(folder: Path) -> xr.DataTree:
    with xr.open_datatree(folder / "posterior.nc") as tree:
        return tree.load()


def same(a: xr.DataTree, b: xr.DataTree) -> bool:
    """Bit for bit, in every group."""
    return all(a[group].to_dataset().equals(b[group].to_dataset()) for group in ("posterior", "sample_stats", "filter"))


def test_a_run_leaves_its_files_and_no_others(run):
    assert {path.name for path in run.iterdir()} == {
        "run.toml",
        "posterior.nc",
        "summary.json",
        "manifest.json",
        "overlay.mp4",
        "overlay",
        "frames",
        ".lock",
    }


def test_the_posterior_opens_as_an_arviz_tree(run):
    tree = posterior(run)
    pose = tree["posterior"]["pose"]
    assert dict(pose.sizes) == {"chain": RUNS, "draw": PARTICLES, "frame": FRAMES, "dof": DOFS}
    assert pose.dims == ("chain", "draw", "frame", "dof")
    assert set(pose.unit.values) == {"rad", "m"}
    for name in ("log_weight", "ancestor"):
        assert tree["sample_stats"][name].dims == ("chain", "draw", "frame")
    np.testing.assert_allclose(np.exp(tree["sample_stats"]["log_weight"]).sum("draw"), 1, rtol=1e-5)
    assert tree["sample_stats"]["ancestor"].values.min() >= 0
    assert tree["sample_stats"]["ancestor"].values.max() < PARTICLES
    assert tree["filter"]["survival_rate"].sizes["layer"] == LAYERS


def test_the_summary(run):
    summary = json.loads((run / "summary.json").read_text())
    assert set(summary) >= KEYS
    expected = {"frames": FRAMES, "frames_lost": 0, "cameras": 4, "dof": DOFS, "particles": PARTICLES, "layers": LAYERS, "runs": RUNS, "seed": 3}
    assert {key: summary[key] for key in expected} == expected
    assert (summary["kernel"], summary["model"]) == ("annealed", "deutscher_2005")
    assert 0 < summary["seconds_compile"] < summary["seconds_total"]
    working = summary["seconds_total"] - summary["seconds_compile"]
    assert summary["seconds_per_frame"] == pytest.approx(working / FRAMES)
    assert summary["evaluations_per_second"] == pytest.approx(RUNS * FRAMES * PARTICLES * LAYERS / working)
    assert 1 <= summary["ess_min"] <= summary["ess_median"] <= PARTICLES
    assert 0.4 < summary["iou_median"] < 1
    assert summary["fit_by"] == "silhouettes" and summary["fit_first"] > 0.9 and summary["fit_worst"] > 0.7 and summary["frames_off"] == []
    assert all("fit the picture" not in sentence and "covers" not in sentence for sentence in summary["warnings"])
    assert summary["rhat_max"] > 0.9
    assert 50 < summary["peak_memory_mb"] < 1e5


def test_the_video_and_the_stills(run):
    video = cv2.VideoCapture(str(run / "overlay.mp4"))
    assert video.isOpened()
    frames = 0
    while video.read()[0]:
        frames += 1
    assert frames == FRAMES
    stills = sorted((run / "overlay").iterdir())
    assert len(stills) == FRAMES
    for still in stills:
        picture = cv2.imread(str(still))
        assert picture is not None
        # Lines were drawn: the recording is grey, they are not.
        assert (picture.max(axis=-1) != picture.min(axis=-1)).any()


@pytest.mark.long
def test_another_seed_gives_another_posterior(run, again):
    assert not same(posterior(run), again("--seed", 6))


@pytest.mark.slow
def test_fewer_frames_are_the_first_ones_of_the_whole(run, again):
    whole, part = posterior(run), again("--frames", 2)
    np.testing.assert_array_equal(whole["posterior"]["pose"].isel(frame=slice(2)), part["posterior"]["pose"])


@pytest.mark.slow
def test_the_run_file_alone_is_enough_to_repeat_the_run(cli, run, tmp_path, monkeypatch):
    """From another folder and in another process, by the same seed: the same posterior, bit for bit."""
    record = tomllib.loads((run / "run.toml").read_text(encoding="utf-8"))
    settings, kernel = record["run"], record["kernel"]
    # By its own name: the posterior carries it.
    definition = tmp_path / f"{Path(settings['model']).stem}.toml"
    definition.write_text(record["definition"]["text"], encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    command = ["track", settings["session"], "--model", str(definition), "--kernel", kernel["kind"], "--out", str(tmp_path / "again")]
    command += ["--particles", str(kernel["particles"]), "--layers", str(kernel["layers"])]
    command += ["--runs", str(settings["runs"]), "--seed", str(settings["seed"])]
    outcome = cli(*command)
    assert outcome.status == 0, outcome.err
    assert same(posterior(run), posterior(tmp_path / "again"))
    assert record["versions"]["jax"]
    assert record["machine"]["devices"]


@pytest.mark.slow
def test_the_session_chooses_the_model_and_the_command_line_another_kernel(cli, walk, tmp_path):
    outcome = cli("track", walk, "--out", tmp_path / "run", "--kernel", "sir", "--particles", 50, "--frames", 2)
    assert outcome.status == 0
    assert "mode seeker" not in outcome.out
    assert "model      silhouettes, because the session has silhouettes (masks) and no keypoints; --model names another." in outcome.out
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["model"] == "silhouettes"
    assert np.isfinite(posterior(tmp_path / "run")["filter"]["log_evidence"]).all()
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["rhat_max"] is None


OPTIONS = {
    "a setting without a value": (["--set", "step"], ["--set: step", "expected NAME=VALUE", "step=0.1"]),
    "a setting of another kernel": (
        ["--set", "step=0.1"],
        ["--set step: the kernel 'annealed' has no such option", "expected one of particles", "leave it out"],
    ),
    "no such kernel": (["--kernel", "aneealed"], ["kernel 'aneealed' does not exist", "did you mean 'annealed'?"]),
    "no such model": (["--model", "deutscher_205"], ["model 'deutscher_205' does not exist", "did you mean 'deutscher_2005'?"]),
    "no such file": (["--model", "nowhere/mine.toml"], ["nowhere/mine.toml", "no such file", "check the path"]),
    "no particles": (["--particles", "0"], ["--particles: 0", "expected a whole number from 1 up", "give another"]),
    "negative particles": (["--particles", "-5"], ["--particles: -5", "expected a whole number from 1 up", "give another"]),
    "no layers": (["--layers", "0"], ["--layers: 0", "expected a whole number from 1 up", "give another"]),
    "no runs": (["--runs", "0"], ["--runs: 0", "expected a whole number from 1 up", "give another"]),
    "no frames": (["--frames", "0"], ["--frames: 0", "expected a whole number from 1 to 4", "give another"]),
    "too many frames": (["--frames", "99"], ["--frames: 99", "expected a whole number from 1 to 4", "give another"]),
    "a seed too large": (["--seed", str(10**30)], ["--seed: 1000000", "expected a whole number from 0 to"]),
    "no such first pose": (["--init", "guessed"], ["--init: 'guessed'", "expected given or auto", "give one of them"]),
    "more particles than memory": (
        ["--particles", str(10**13)],
        ["GB of memory for 10000000000000 particles; expected at most", "GB that there"],
    ),
    "more runs than memory": (
        ["--runs", str(10**10)],
        ["GB of memory for 1000 particles in each of 10000000000 runs;", "give fewer"],
    ),
    "absurdly many layers": (["--layers", str(10**9)], ["the kernel's layers: 1000000000", "expected at most 100000"]),
    "absurdly many moves": (["--kernel", "tempered", "--set", "moves=1000000000"], ["the kernel's moves: 1000000000", "expected at most 100000"]),
    "absurdly many steps": (["--kernel", "hmc", "--leapfrog-steps", str(10**9)], ["the kernel's leapfrog_steps: 1000000000", "expected at most"]),
    "an option twice": (["--particles", "20", "--set", "particles=5"], ["--set particles=5: particles is given already, 20", "leave one"]),
    "a setting twice": (["--set", "layers=3", "--set", "layers=5"], ["--set layers=5: layers is given already, 3", "leave one"]),
    "layers of sir": (["--kernel", "sir", "--layers", "3"], ["--layers", "'sir' has no such option", "expected one of particles", "leave it out"]),
}


@pytest.mark.parametrize("fault", OPTIONS)
def test_options_that_cannot_be_used(cli, walk, tmp_path, fault):
    options, parts = OPTIONS[fault]
    model = [] if "--model" in options else ["--model", "deutscher_2005"]
    cli("track", walk, "--out", tmp_path / "run", *model, *options).refuses(*parts)
    # So that the same command, corrected, is not refused for what this one left.
    assert not list((tmp_path / "run").glob("*"))


def test_a_folder_that_holds_another_run(cli, walk, run):
    before = (run / "posterior.nc").read_bytes()
    cli("track", walk, "--out", run).refuses(str(run), f"holds a run that has {FRAMES} frames", "expected", "--out")
    assert (run / "posterior.nc").read_bytes() == before


def test_a_run_that_is_finished_says_so_and_stays(cli, walk, run):
    before = (run / "posterior.nc").read_bytes()
    outcome = cli("track", walk, "--out", run, "--resume")
    assert outcome.status == 0, outcome.err
    assert f"all {FRAMES} frames exist, nothing is left to track" in outcome.out
    assert (run / "posterior.nc").read_bytes() == before


def test_another_run_is_not_continued(cli, walk, run):
    said = ["kernel.particles was 100 and is now 101", "--seed was 3 and is now 4", "expected the settings with which the run started", "--out"]
    cli("track", walk, "--out", run, "--resume", "--seed", 4, "--particles", 101).refuses(str(run), "cannot be continued", *said)
    cli("track", walk, "--out", run, "--resume", "--frames", 2).refuses("--frames: 2", "at least the 4 frames that the run has")


def test_an_out_that_is_a_file(cli, walk, tmp_path):
    (tmp_path / "run").write_text("mine")
    cli("track", walk, "--out", tmp_path / "run").refuses(
        str(tmp_path / "run"), "cannot be made", "expected a writable folder", "name another folder"
    )
    assert (tmp_path / "run").read_text() == "mine"


def test_a_session_folder_without_a_session(cli, tmp_path):
    (tmp_path / "empty").mkdir()
    cli("track", tmp_path / "empty", "--out", tmp_path / "run").refuses(str(tmp_path / "empty"), "no session.toml", "`bayes-body import`")
    cli("track", tmp_path / "none", "--out", tmp_path / "run").refuses(str(tmp_path / "none"), "no such folder", "check the path")


SESSIONS = {
    "syntax": (("fps = 60.0", "fps = = 60"), ["line ", "fps = = 60", "expected TOML"]),
    "unknown key": (("fps = 60.0", "fps = 60.0\ntitel = 1"), ["titel", "unknown key", "did you mean 'title'?"]),
    "NaN": (("fps = 60.0", "fps = nan"), ["fps = nan", "expected a"]),
    "millimetres": (("torso = 0.578571268", "torso = 578.5"), ["torso", "578.5", "millimetres", "divide by 1000"]),
    "no such dof": (("[initial.angles_deg]\n", "[initial.angles_deg]\nl_kneee = 1.0\n"), ["'l_kneee'", "not a dof", "did you mean 'l_knee'?"]),
    "outside the limits": (("l_knee = ", "l_knee = 200.0 # "), ["'l_knee'", "200 degrees", "expected a value between -155 and 10 degrees", "limits"]),
}


@pytest.mark.parametrize("fault", SESSIONS)
def test_a_session_that_cannot_be_used(cli, walk, tmp_path, fault):
    (old, new), parts = SESSIONS[fault]
    text = (walk / "session.toml").read_text(encoding="utf-8")
    head, sep, initial = text.partition("[initial.angles_deg]") if fault == "outside the limits" else ("", "", text)
    assert old in initial
    (tmp_path / "session.toml").write_text(head + sep + initial.replace(old, new, 1), encoding="utf-8")
    cli("track", tmp_path, "--out", tmp_path / "run", "--model", "deutscher_2005").refuses("session.toml", *parts)


def test_a_session_without_masks(cli, walk, tmp_path):
    lines = (walk / "session.toml").read_text(encoding="utf-8").splitlines()
    (tmp_path / "session.toml").write_text("\n".join(line for line in lines if not line.startswith("masks")), encoding="utf-8")
    said = ["no masks", "expected a silhouette", "give each [[camera]] its `masks`"]
    cli("track", tmp_path, "--out", tmp_path / "run", "--model", "deutscher_2005").refuses("session.toml", *said)
    # Nothing that a model could be chosen by.
    cli("track", tmp_path, "--out", tmp_path / "run").refuses("session.toml", "neither keypoints nor silhouettes", "--keypoints", "--model")


@pytest.fixture
def trial(textured_session, tmp_path) -> Path:
    """A session of blobs in a folder `trial`."""
    folder = tmp_path / "trial"
    save_session(dataclasses.replace(textured_session, folder=folder))
    for view in textured_session.views:
        (folder / view.camera.name).symlink_to(textured_session.folder / view.camera.name)
    return folder


@pytest.mark.slow
def test_without_an_out_each_run_has_a_folder_of_its_own(cli, trial, monkeypatch):
    monkeypatch.chdir(trial.parent)
    outcome = cli("track", "trial", "--model", "arm", "--particles", 20, "--frames", 1)
    assert outcome.status == 0, outcome.err
    assert outcome.out.startswith("run        trial_run\n")
    first = (trial.parent / "trial_run" / "posterior.nc").stat().st_mtime_ns
    # What `look at` was before.
    assert "look at    " not in outcome.out
    assert "warning     a single run cannot show whether another run would agree; use --runs 2 or more." in outcome.out
    monkeypatch.chdir(trial)
    outcome = cli("track", ".", "--model", "arm", "--particles", 20, "--frames", 1)
    assert outcome.status == 0, outcome.err
    assert (trial.parent / "trial_run_2" / "posterior.nc").exists()
    assert (trial.parent / "trial_run" / "posterior.nc").stat().st_mtime_ns == first


def test_a_run_is_continued_by_its_own_name_only(cli, trial):
    cli("track", trial, "--resume").refuses("--resume: no --out", "name it with --out")


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (["--wait", 5], "--wait: 5 without --live; expected --live FOLDER"),
        (["--port", 80], "--port: 80 without --live"),
        (["--live", "nowhere"], "--live nowhere: no such folder; expected the folder to which the pose estimator writes"),
        (["--live", ".", "--wait", 0], "--wait: 0; expected seconds, above 0"),
        (["--live", ".", "--port", 70_000], "--port: 70000; expected a whole number from 0 to 65535"),
        (["--live", ".", "--model", "arm_markers"], "its cameras have no keypoints"),
    ],
)
def test_wrong_options_of_a_live_run(textured_session, cli, tmp_path, options, problem):
    save_session(dataclasses.replace(textured_session, folder=tmp_path / "session"))
    for name in ("a", "b"):
        (tmp_path / f"{name}_json").mkdir()
    options = [tmp_path if option == "." else option for option in options]
    cli("track", tmp_path / "session", "--out", tmp_path / "run", *options).refuses(problem)
