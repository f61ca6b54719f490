"""`bayes-body compare`: what it prints and writes of runs whose evidence is known, and why runs cannot be compared."""

import json
import tomllib
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import tomlkit
from sealed import seal

from bayes_body.cli.main import main
from bayes_body.runs import window_comparison

FRAMES = 6


@pytest.fixture
def runs(make_run):
    """`runs(name, total, sd, ...)`: a run whose filters' log-evidences have that mean and standard deviation, with a changed run.toml."""

    def call(name, total=0.0, spread=0.0, chains=4, seed=0, changes=(), frames=FRAMES, **arrays):
        steps = np.linspace(-1, 1, chains)
        by_run = total + (spread * steps / steps.std(ddof=1) if chains > 1 else 0 * steps)
        log_evidence = arrays.pop("log_evidence", np.repeat(by_run[:, None] / frames, frames, axis=1))
        folder = make_run(name, runs=chains, frames=frames, log_evidence=log_evidence, **arrays)
        path = folder / "run.toml"
        record = tomllib.loads(path.read_text())
        record["run"] |= {"seed": seed, "model": name}
        for table, key, old, new in changes:
            if isinstance(old, str):
                assert old in record[table][key]
                new = record[table][key].replace(old, new)
            record.setdefault(table, {})[key] = new
        path.write_text(tomlkit.dumps(record))
        seal(folder, frames)
        return folder

    return call


def _compared(capsys, *arguments):
    """Exit status, standard output and standard error."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as stopped:
        main(["compare", *map(str, arguments)])
    return stopped.value.code, *capsys.readouterr()


def test_models_are_ranked_and_the_better_one_is_named(runs, capsys, tmp_path):
    slow, fast, middle = runs("slow", -94.0, 0.2), runs("fast", 0.0, 0.2), runs("middle", -10.0, 0.2)
    status, out, _ = _compared(capsys, slow, fast, middle, "--out", tmp_path / "all")
    assert status == 0
    assert [line.split()[0] for line in out.splitlines()[:4]] == ["model", "fast", "middle", "slow"]
    # Of four runs of each model: 0.1 sqrt(2).
    assert "`fast` is preferred to `middle` by 10.0 ± 0.1 nats over 6 frames (95 % from 9.6 to 10.4)." in out and "note:" not in out
    found = json.loads((tmp_path / "all" / "comparison.json").read_text())
    assert found["preferred"] == "fast" and found["sentence"] in out and found["recording"]["frames"] == FRAMES
    last = found["models"][2]
    assert last["name"] == "slow" and last["runs"] == 4 and last["log_evidence_sd"] == pytest.approx(0.2)
    assert last["difference"] == pytest.approx(-94, abs=0.05) and last["per_frame"] == pytest.approx(-94 / 6, abs=0.05)
    low, high = last["difference_interval"]
    assert low < -94 < high and len(last["difference_by_frame"]["value"]) == FRAMES
    picture = cv2.imread(str(tmp_path / "all" / "comparison.png"))
    assert picture.shape[1] > 1000 and np.ptp(picture) > 100


def test_runs_of_one_model_count_together(runs, capsys):
    folders = [runs("a", -5.0 + step, seed=seed, chains=1) for seed, step in ((0, -0.1),)]
    # The same model by another name of its folder.
    other = runs("b", -4.9, seed=1, chains=1, changes=[("run", "model", None, "a")])
    status, out, _ = _compared(capsys, *folders, other, runs("c", 0.0, 0.1))
    assert status == 0 and [line.split()[:3] for line in out.splitlines()[1:3]] == [["c", "sir", "4"], ["a", "sir", "2"]]
    status, _, err = _compared(capsys, folders[0], folders[0], runs("d"))
    assert status == 2 and "has the seed 0" in err and "independent runs" in err


def test_there_is_no_verdict_where_the_runs_disagree_or_are_alone(runs, capsys):
    rough, sharp = runs("rough", -3.0, 5.0), runs("sharp", 0.0, 0.2)
    _, out, _ = _compared(capsys, rough, sharp)
    assert "There is no verdict: the runs of `rough` (sd 5.0 nats) disagree too much, or are too few, for a difference of" in out
    assert "the runs of `rough` disagree (sd 5.0 nats, limit 2), most in frame 0: about 7 times as many particles would do." in out
    # A difference that no disagreement of this size hides.
    _, out, _ = _compared(capsys, runs("wild", -90.0, 50.0), sharp)
    assert "the runs of `wild` disagree (sd 50.0 nats, limit 2), most in frame 0: take another kernel, such as tempered." in out
    _, out, _ = _compared(capsys, rough, runs("far", 800.0, 0.2))
    assert "`far` is preferred to `rough`" in out and "note: the runs of `rough` disagree" in out
    _, out, _ = _compared(capsys, sharp, runs("alike", 0.3, 0.2))
    assert "The images do not tell `alike` from `sharp`: they differ by 0.3 ± 0.1 nats over 6 frames" in out
    _, out, _ = _compared(capsys, sharp, runs("single", 4.0, chains=1))
    assert "the Monte Carlo error of one run of `single` is unknown; track two or more runs of each model." in out
    lost = np.zeros((4, FRAMES))
    lost[1, 3] = -np.inf
    _, out, _ = _compared(capsys, sharp, runs("lost", log_evidence=lost))
    assert "There is no verdict: the runs of `lost` (some lost a frame) disagree" in out and "1 of 4 runs of `lost` lost a frame" in out
    lost[:, 3] = -np.inf
    _, out, _ = _compared(capsys, sharp, runs("gone", log_evidence=lost))
    assert "There is no verdict: no run of `gone` explains every frame" in out


REFUSED = {
    "other frames": ({"frames": 4}, "4 frames, and 6 in the first run; expected the same frames in all runs"),
    "another recording": ({"changes": [("session", "text", "fps = ", "fps = 1")]}, "session.toml: fps is"),
    "other images": ({"changes": [("inputs", "images of a", None, "ffff")]}, "images of a is ffff, and not set in the first run"),
    "another first frame": ({"changes": [("run", "first_frame", None, 0)]}, "--first-frame is 0"),
    "another likelihood": (
        {"changes": [("definition", "text", "precision = 200.0", "precision = 10.0")]},
        "likelihood #1: precision is 10.0, and 200.0 in the first run; expected the same likelihood in all runs",
    ),
    "another body": (
        {"changes": [("definition", "body_text", "height_m = 1.75", "height_m = 1.76")]},
        "is no distribution over data; expected one body",
    ),
    "a mode seeker": ({"log_evidence": np.full((4, FRAMES), np.nan)}, "the kernel 'sir' seeks modes and estimates no evidence"),
    "no evidence in a frame": ({"log_evidence": np.where(np.arange(FRAMES) == 2, np.nan, np.zeros((4, 1)))}, "no evidence in frame 2"),
}


def test_a_session_is_tracked_with_each_model_as_a_study(runs, capsys, tmp_path, monkeypatch):
    """The engine of studies has its own tests; here it finds its runs made."""
    out, studies = tmp_path / "out", []

    def run_study(study, folder, show, bar):
        studies.append(study)
        for variant, total in (("arm", 0.0), ("mine", -30.0)):
            for number in (1, 2):
                made = runs(f"{variant}{number}", total + 0.1 * number, chains=1, seed=number, changes=[("run", "model", None, variant)])
                made.rename((folder / "session").mkdir(parents=True, exist_ok=True) or folder / "session" / f"{variant}_run_{number}")
        return True

    monkeypatch.setattr("bayes_body.runs.study.study.run_study", run_study)
    runs("first")
    mine = tmp_path / "mine.toml"
    status, text, _ = _compared(
        capsys, tmp_path / "session", "--model", "arm", "--model", mine, "--runs", 2, "--frames", FRAMES, "--particles", 30, "--out", out
    )
    assert status == 0 and "`arm` is preferred to `mine` by 30 ± 0.1 nats over 6 frames" in text
    (study,) = studies
    assert [(variant.name, variant.model) for variant in study.variant] == [("arm", "arm"), ("mine", str(mine))]
    assert (study.runs, study.frames, study.particles, study.steps, study.pictures) == (2, FRAMES, 30, [], False)
    assert (out / "comparison.json").exists() and (out / "comparison.png").exists()


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_compared_is_refused_in_a_sentence(runs, capsys, case):
    options, sentence = REFUSED[case]
    first, other = runs("first"), runs("other", **options)
    status, out, err = _compared(capsys, first, other)
    assert status == 2 and out == "" and sentence in err and err.count("\n") == 1 and str(other) in err


def test_another_motion_or_limit_is_a_prior(runs, capsys):
    slower = runs("slower", -2.0, 0.1, changes=[("definition", "text", "[dynamics.sd_deg]", '[dynamics.sd_m]\n"none_*" = 1.0\n[dynamics.sd_deg]')])
    status, out, _ = _compared(capsys, runs("first", 0.0, 0.1), slower)
    assert status == 0 and "`first` is preferred to `slower`" in out


@pytest.mark.slow
def test_a_window_says_what_its_chains_say(runs, capsys, tmp_path, monkeypatch):
    """The chains themselves are tested in closed_forms/test_window_evidence.py, and all together in programs/test_window.py."""
    sampled = {}

    def window_of_run(folder, frames, first, seed, prior, **options):
        value, error, r_hat = sampled[folder.name]
        draws = SimpleNamespace(r_hat=np.array([1.0, r_hat]), divergent=np.array([[False, False]]))
        return SimpleNamespace(evidence=(value, error), draws=draws)

    monkeypatch.setattr(window_comparison, "window_of_run", window_of_run)
    monkeypatch.setattr(window_comparison, "check_constraints", lambda folders: None)
    rough, again, sharp = runs("rough", -3.0, 5.0), runs("again", seed=1, changes=[("run", "model", None, "rough")]), runs("sharp", 0.0, 0.2)
    command = [rough, again, sharp, "--window", "2-4", "--out", tmp_path / "out"]
    sampled |= {"rough": (-8.0, 0.1, 1.0), "again": (-7.0, 0.1, 1.0), "sharp": (-2.0, 0.1, 1.0)}
    status, out, _ = _compared(capsys, *command)
    # The two folders of a model differ by more than their errors: their spread is the error.
    assert status == 0 and "In frames 2-4, by bridge sampling, `sharp` is preferred to `rough` by 5.4 ± 0.51 nats, given the images before." in out
    found = json.loads((tmp_path / "out" / "comparison.json").read_text())["window"]
    assert found["preferred"] == "sharp" and found["models"][1]["log_evidence"] == pytest.approx(np.log(np.mean(np.exp([-8.0, -7.0]))))
    assert found["models"][0]["filters"] == pytest.approx(0, abs=0.1) and found["models"][0]["filters_sd"] == pytest.approx(0.1)
    for change, sentence in (
        ((-2.0, 0.1, 1.2), "there is no verdict: the chains of `sharp` (R-hat 1.20, limit 1.01) do not agree"),
        ((-7.0, 0.1, 1.0), "do not tell `sharp` from `rough`: they differ by 0.4 ± 0.51 nats"),
        ((float("nan"), float("nan"), 1.0), "no normal distribution reaches the draws of `sharp`"),
    ):
        sampled["sharp"] = change
        assert sentence in _compared(capsys, *command)[1]
    for window, sentence in (("0-3", "expected ascending frames from 1 to 5"), ("4-9", "from 1 to 5"), ("3", "--window: 3; expected its first")):
        status, _, err = _compared(capsys, rough, sharp, "--window", window)
        assert status == 2 and sentence in err


def test_a_window_counts_constraints_as_seen(runs, capsys):
    person = {"model": "silhouettes", "pose": np.zeros((4, 30, FRAMES, 31))}
    first, other = runs("first", **person), runs("other", changes=[("definition", "text", "yield_m = 0.03", "yield_m = 0.02")], **person)
    status, _, err = _compared(capsys, first, other, "--window", "2-4")
    assert status == 2 and "constraint #1: yield_m is 0.02, and 0.03 in the first run" in err


def test_arguments_that_make_no_comparison_are_sentences(runs, capsys, tmp_path):
    run = runs("only")
    session = tmp_path / "session"
    cases = {
        (run,): "the runs: 1; expected two or more",
        (run, runs("same", seed=1, changes=[("run", "model", None, "only")])): "only one model and kernel",
        (run, run, "--frames", 3): "--frames: given with finished runs",
        (session,): "a session, without --model",
        (session, "--model", "arm"): "--model: one model; expected two or more",
        (session, "--model", "arm", "--model", "silhouettes"): "--out: missing",
        (run, tmp_path / "nowhere"): "no such folder",
    }
    for arguments, sentence in cases.items():
        status, _, err = _compared(capsys, *arguments)
        assert status == 2 and sentence in err and err.count("\n") == 1
