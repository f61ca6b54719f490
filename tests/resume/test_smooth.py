"""A smoothed run on disk: it goes on after a stop to the same paths, is read like any other run, and refuses what it cannot smooth."""

import dataclasses

import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.cli.main import main
from bayes_body.results.storage import FrameFiles, frame_files
from bayes_body.results.storage.saved_run import SavedRun, load_run
from bayes_body.runs.run import run
from bayes_body.runs.settings import Settings
from bayes_body.runs.smooth import SmoothSettings, smooth_run
from bayes_body.tracking import gaussian_walk
from bayes_body.view.export.formats import export
from bayes_body.view.report.curves import dof_curves, filter_curves
from bayes_body.view.report.page import page

from .conftest import contents

# Without moves by default: the program of a move compiles for long.
FRAMES, DRAWS = 6, {"draws": 30, "moves": 0}
FILTER = {"model": "arm", "kernel": "sir", "overrides": {"particles": 200}, "runs": 2, "seed": 3}


def quiet(line):
    """Show nothing."""


@pytest.fixture(scope="module")
def filtered(looped, tmp_path_factory):
    """The run of a particle filter."""
    out = tmp_path_factory.mktemp("filtered") / "run"
    run(Settings(looped(FRAMES), out, **FILTER), quiet, bar=False)
    return out


@pytest.fixture(scope="module")
def smoothed(filtered, tmp_path_factory):
    out = tmp_path_factory.mktemp("smoothed") / "run"
    smooth_run(SmoothSettings(filtered, out, DRAWS), quiet, bar=False)
    return out


@pytest.mark.slow
def test_a_smoothed_run_is_read_like_any_other(filtered, smoothed, tmp_path):
    with load_run(smoothed) as paths, load_run(filtered) as source:
        assert paths.smoothed and not source.smoothed and not paths.mode_seeker
        poses, weights = paths.tree["posterior"]["pose"], paths.tree["sample_stats"]["log_weight"]
        assert poses.sizes == {"chain": 2, "draw": 30, "frame": FRAMES, "dof": source.tree["posterior"].sizes["dof"]}
        np.testing.assert_allclose(weights, -np.log(30), rtol=1e-6)
        # The last frame knows all images already in the filter, the frames before do not.
        assert np.array_equal(paths.tree["filter"]["log_evidence"], source.tree["filter"]["log_evidence"])
        text = page(paths)
        assert "smoothed: 30 paths of each run, given all images" in text and 'id="filter"' not in text and "the filter&#x27;s mean" in text
        assert f"bayes-body smooth {filtered} --out {smoothed}_again --draws 30 --start ensemble --moves 0 --seed 0" in text
        # The curves beside are those of the filter's run, and of no other run to which a stranger's run may lead.
        frames = range(FRAMES)
        np.testing.assert_array_equal(filter_curves(paths, frames).dofs.mean, dof_curves(source, frames).mean)
        for other in ({"run": "0" * 32}, {"folder": str(smoothed)}, {"folder": "\0"}, {"folder": str(tmp_path)}):
            assert filter_curves(dataclasses.replace(paths, smoothing=paths.smoothing | other), frames) is None
        assert filter_curves(dataclasses.replace(paths, texts=paths.texts | {"session": ""}), frames) is None
        assert filter_curves(source, frames) is None
        export(paths, "csv", tmp_path / "motion.csv")
    assert len((tmp_path / "motion.csv").read_text().splitlines()) == FRAMES + 1


@pytest.mark.slow
@pytest.mark.parametrize("moves", [0, 1])
def test_after_a_stop_it_goes_on_to_the_same_paths(filtered, smoothed, tmp_path, monkeypatch, moves):
    whole, out, lines, save = smoothed, tmp_path / "run", [], frame_files.save_frame
    draws = DRAWS | {"moves": moves}
    if moves:
        whole = tmp_path / "whole"
        smooth_run(SmoothSettings(filtered, whole, draws), quiet, bar=False)

    def save_or_stop(path, result, place):
        if path.name == "000003.npz":
            monkeypatch.setattr(frame_files, "save_frame", save)
            raise KeyboardInterrupt
        return save(path, result, place)

    monkeypatch.setattr(frame_files, "save_frame", save_or_stop)
    with pytest.raises(KeyboardInterrupt):
        smooth_run(SmoothSettings(filtered, out, draws), lines.append, bar=False)
    assert lines[-1] == f"{out}: 3 frames are kept; the same command with --resume continues from there."
    with pytest.raises(InputError, match=r"bayes-body smooth .* --resume"):
        load_run(out)
    with pytest.raises(InputError, match=r"smoothing.draws was 30 and is now 31"):
        smooth_run(SmoothSettings(filtered, out, {"draws": 31}, resume=True), lines.append, bar=False)
    smooth_run(SmoothSettings(filtered, out, {}, resume=True), lines.append, bar=False)
    assert contents(out / "posterior.nc") == contents(whole / "posterior.nc")
    assert (out / "posterior.nc").read_bytes() == (whole / "posterior.nc").read_bytes()


@pytest.mark.slow
def test_gaussian_paths_go_on_in_pieces_to_the_same_paths(filtered, tmp_path, monkeypatch):
    whole, out, lines, write, draws = tmp_path / "whole", tmp_path / "run", [], frame_files.write_together, DRAWS | {"start": "gaussian"}
    monkeypatch.setattr(gaussian_walk, "PIECE", 2)
    smooth_run(SmoothSettings(filtered, whole, draws, pictures=False), quiet, bar=False)

    def write_or_stop(contents):
        if any(path.name == "000003.npz" for path in contents):
            monkeypatch.setattr(frame_files, "write_together", write)
            raise KeyboardInterrupt
        return write(contents)

    monkeypatch.setattr(frame_files, "write_together", write_or_stop)
    with pytest.raises(KeyboardInterrupt):
        smooth_run(SmoothSettings(filtered, out, draws, pictures=False), lines.append, bar=False)
    assert lines[-1] == f"{out}: 2 frames are kept; the same command with --resume continues from there."
    smooth_run(SmoothSettings(filtered, out, {}, resume=True, pictures=False), quiet, bar=False)
    assert contents(out / "posterior.nc") == contents(whole / "posterior.nc")
    with load_run(out) as paths:
        assert set(np.unique(paths.tree["filter"]["ess"])) == {DRAWS["draws"]}


def test_other_folders_are_refused(filtered, smoothed, looped, tmp_path):
    seeker = tmp_path / "seeker"
    run(Settings(looped(2), seeker, **FILTER | {"kernel": "annealed", "overrides": {"particles": 20, "layers": 2}}), quiet, bar=False)
    for source, out, said in (
        (seeker, tmp_path / "a", "the kernel 'annealed' seeks modes: its particles are not a sample of the posterior"),
        (smoothed, tmp_path / "b", "smoothed paths; expected the run of a filter"),
        (filtered, filtered, "expected another folder than the filter's"),
        (filtered, smoothed, "holds a run that has 6 frames"),
        (tmp_path / "none", tmp_path / "c", "no such folder"),
    ):
        with pytest.raises(InputError, match=said):
            smooth_run(SmoothSettings(source, out, DRAWS), quiet, bar=False)
    with pytest.raises(InputError, match="--moves: given with the start 'joint', whose paths do not move"):
        smooth_run(SmoothSettings(filtered, tmp_path / "d", {"start": "joint", "moves": 2}), quiet, bar=False)
    with pytest.raises(InputError, match=r"smoothing\.start was ensemble and is now joint"):
        smooth_run(SmoothSettings(filtered, smoothed, {"start": "joint"}, resume=True), quiet, bar=False)
    assert not (tmp_path / "d" / "run.toml").exists()
    with pytest.raises(InputError, match="a smoothed run; expected the run of a filter"):
        run(Settings(looped(FRAMES), smoothed, resume=True), quiet, bar=False)
    with pytest.raises(InputError, match="the run of a filter; expected a smoothed run"):
        smooth_run(SmoothSettings(filtered, seeker, DRAWS, resume=True), quiet, bar=False)


@pytest.mark.slow
def test_without_its_recording_a_run_is_smoothed_only_without_moves(filtered, tmp_path, monkeypatch):
    monkeypatch.setattr(SavedRun, "changed_inputs", frozenset({"images of a"}))
    with pytest.raises(InputError, match=r"images of a: changed or gone since the run was made; .*--moves 0"):
        smooth_run(SmoothSettings(filtered, tmp_path / "a", DRAWS | {"moves": 1}), quiet, bar=False)
    smooth_run(SmoothSettings(filtered, tmp_path / "b", DRAWS), quiet, bar=False)
    assert len(FrameFiles(tmp_path / "b" / "frames")) == FRAMES


@pytest.mark.slow
def test_the_command_says_where_the_result_is(filtered, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["smooth", str(filtered), "--draws", "10", "--moves", "0"])
    assert stopped.value.code == 0
    printed = capsys.readouterr().out
    assert f"run        {filtered}_smoothed\n" in printed and f"{filtered}_smoothed: posterior.nc" in printed
    with pytest.raises(SystemExit):
        main(["smooth", str(filtered.with_name("nowhere"))])
    assert capsys.readouterr().out == ""
