"""Independent runs put together: their draws are the chains of one run, which goes on after a stop to the same bits, and refuses strangers."""

import shutil

import cv2
import numpy as np
import pytest
import xarray as xr

from bayes_body.base.errors import InputError
from bayes_body.cli.main import main
from bayes_body.results.posterior.diagnostics import diagnose
from bayes_body.results.storage import frame_archive
from bayes_body.results.storage.run_file import read_run_file, write_run_file
from bayes_body.results.storage.saved_run import load_run
from bayes_body.runs.run import run
from bayes_body.runs.settings import Settings
from bayes_body.runs.smooth import SmoothSettings, smooth_run
from bayes_body.runs.study.combine import combine_runs
from bayes_body.view.report.head import provenance_section
from bayes_body.view.study.rows import read_summary, row_of
from bayes_body.view.study.thumbnail import WIDTH, write_thumbnail

from .conftest import digests

FRAMES, PARTICLES, SEEDS = 6, 60, (3, 4, 11)
FILTER = {"model": "arm", "kernel": "sir", "overrides": {"particles": PARTICLES}, "pictures": False}


def quiet(line):
    """Show nothing."""


@pytest.fixture(scope="module")
def singles(looped, tmp_path_factory):
    """Runs of one filter each, with other seeds."""
    folder = tmp_path_factory.mktemp("singles")
    for seed in SEEDS:
        run(Settings(looped(FRAMES), folder / f"run_{seed}", seed=seed, **FILTER), quiet, bar=False)
    return [folder / f"run_{seed}" for seed in SEEDS]


@pytest.fixture(scope="module")
def combined(singles, tmp_path_factory):
    out = tmp_path_factory.mktemp("combined") / "all_runs"
    combine_runs(singles, out, quiet, bar=False)
    return out


def concatenated(folders):
    """The tree of all runs, one after the other as chains, in memory."""
    trees = [xr.load_datatree(folder / "posterior.nc") for folder in folders]
    groups = {}
    for name in trees[0].children:
        datasets = [tree[name].to_dataset() for tree in trees]
        groups[name] = xr.concat(datasets, "chain", data_vars="minimal", compat="equals", join="override")
    tree = xr.DataTree.from_dict(groups)
    tree.attrs.update(trees[0].attrs)
    return tree


def assert_same_figures(ours, theirs, **tolerance):
    for name in ("ess", "pareto_k", "ancestors", "rhat", "independent_draws", "log_evidence", "lost"):
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), **tolerance, err_msg=name)


def test_each_run_is_a_chain_bit_for_bit_and_the_figures_are_of_all(singles, combined):
    with load_run(combined) as together:
        assert together.settings["runs"] == len(SEEDS) and together.frames == FRAMES
        assert together.chains["seeds"] == together.summary["seeds"] == list(SEEDS) and together.chains["folders"] == [str(path) for path in singles]
        for place, folder in enumerate(singles):
            with load_run(folder) as single:
                assert together.chains["runs"][place] == single.id
                for name in ("posterior", "sample_stats", "filter"):
                    chain = together.tree[name].to_dataset().isel(chain=slice(place, place + 1))
                    for variable, values in single.tree[name].to_dataset().data_vars.items():
                        assert chain[variable].values.tobytes() == values.values.tobytes(), variable
        diagnosis = diagnose(together)
        assert_same_figures(diagnosis, diagnose(concatenated(singles)), rtol=1e-12)
        assert np.isfinite(diagnosis.rhat).any() and together.summary["rhat_max"] == pytest.approx(np.nanmax(diagnosis.rhat), rel=1e-6)
        assert together.summary["runs"] == len(SEEDS)
        text = provenance_section(together)
        assert f"bayes-body combine {singles[0]} " in text and "seed 11" in text and "--keep all" in text


def test_a_row_of_a_study_shows_the_figures_and_the_picture_of_all_runs(singles, combined, tmp_path):
    picture, out = tmp_path / "walk" / "picture.jpg", tmp_path
    assert write_thumbnail(combined, picture) and cv2.imread(str(picture)).shape[1] == WIDTH and not write_thumbnail(singles[0], picture)
    row, summary = row_of("walk", "", read_summary(combined), combined, "done", out, picture=picture), read_summary(combined)
    assert row.picture == "walk/picture.jpg" and row.frames == FRAMES and row.rhat == summary["rhat_max"]
    assert row.warnings == len(summary["warnings"]) > 0 and row.warning == summary["warnings"][0]
    assert row.seconds == pytest.approx(sum(read_summary(folder)["seconds_total"] for folder in singles))


@pytest.mark.slow
def test_after_a_stop_it_is_made_again_to_the_same_bits_and_once_made_it_stays(singles, combined, tmp_path, monkeypatch):
    out, lines, write = tmp_path / "all_runs", [], frame_archive.FrameArchive.write

    def stop(archive, folder):
        monkeypatch.setattr(frame_archive.FrameArchive, "write", write)
        raise KeyboardInterrupt

    monkeypatch.setattr(frame_archive.FrameArchive, "write", stop)
    with pytest.raises(KeyboardInterrupt):
        combine_runs(singles, out, lines.append, bar=False, pictures=False)
    with pytest.raises(InputError):
        load_run(out)
    # As a process leaves it that is killed while it writes.
    (out / ".partial-0123456789abcdef.nc").write_bytes(b"half")
    combine_runs(singles, out, lines.append, bar=False, pictures=False)
    assert (out / "posterior.nc").read_bytes() == (combined / "posterior.nc").read_bytes()
    before = digests(out)
    assert not any(".partial" in name for name in before)
    summary = combine_runs(singles, out, lines.append, bar=False, pictures=False)
    assert lines[-1] == f"{out}: these 3 runs are together already" and digests(out) == before and summary["runs"] == 3
    # Another run in the place of one of them.
    combine_runs(singles[1:], out, lines.append, bar=False, pictures=False)
    assert f"{out}: made anew, because its runs have changed or are others" in lines
    fresh = tmp_path / "fresh"
    combine_runs(singles[1:], fresh, quiet, bar=False, pictures=False)
    assert digests(out / "posterior.nc") == digests(fresh / "posterior.nc") and digests(out / "frames") == digests(fresh / "frames")


@pytest.mark.slow
def test_fewer_draws_have_the_figures_of_all_particles(singles, combined, looped, tmp_path):
    few, lines = tmp_path / "few", []
    summary = combine_runs(singles, few, quiet, bar=False, keep=20, pictures=False)
    with load_run(few) as thinned, load_run(combined) as whole:
        assert thinned.kept == thinned.tree["posterior"].sizes["draw"] == 20 and diagnose(thinned).particles == PARTICLES
        assert_same_figures_of_all(diagnose(thinned), diagnose(whole))
        assert summary["rhat_max"] == pytest.approx(whole.summary["rhat_max"], rel=1e-6)
    # Runs that are thinned already are stored as they are, and their means are still those of all particles.
    sources = [tmp_path / f"thinned_{seed}" for seed in SEEDS]
    for seed, source in zip(SEEDS, sources, strict=True):
        run(Settings(looped(FRAMES), source, seed=seed, keep=20, **FILTER), quiet, bar=False)
    with pytest.raises(InputError, match="--keep is draws=20, and not set in the first run"):
        combine_runs([singles[0], sources[1]], tmp_path / "mixed", quiet, bar=False)
    combine_runs(sources, tmp_path / "again", lines.append, bar=False, pictures=False)
    with load_run(tmp_path / "again") as again, load_run(sources[1]) as source:
        chain = again.tree["posterior"]["pose"].isel(chain=1)
        assert again.kept == 20 and chain.values.tobytes() == source.tree["posterior"]["pose"].values.tobytes()


def assert_same_figures_of_all(ours, theirs):
    for name in ("ess", "pareto_k", "rhat", "independent_draws", "log_evidence"):
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), rtol=1e-5, err_msg=name)


@pytest.mark.slow
def test_smoothed_runs_are_put_together_path_by_path(singles, tmp_path):
    paths = [tmp_path / f"smoothed_{place}" for place in range(2)]
    for place, (source, out) in enumerate(zip(singles, paths, strict=False)):
        smooth_run(SmoothSettings(source, out, {"draws": 30, "moves": 0}, seed=place, pictures=False), quiet, bar=False)
    out = tmp_path / "smoothed"
    summary = combine_runs(paths, out, quiet, bar=False, pictures=False)
    with load_run(out) as together, load_run(paths[1]) as single:
        assert together.smoothed and summary["angles"] is not None
        poses = together.tree["posterior"]["pose"]
        assert poses.isel(chain=1).values.tobytes() == single.tree["posterior"]["pose"].values.tobytes()
        assert_same_figures(diagnose(together), diagnose(concatenated(paths)), rtol=1e-12)
    with pytest.raises(InputError, match="smoothed runs that were put together; expected a smoothed run"):
        smooth_run(SmoothSettings(singles[0], out, {}, resume=True), quiet, bar=False)


@pytest.mark.slow
def test_a_run_made_of_several_is_smoothed_and_exported_like_any_other(combined, tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["smooth", str(combined), "--out", str(tmp_path / "smoothed"), "--draws", "30", "--moves", "0", "--no-pictures"])
    assert ended.value.code == 0, capsys.readouterr().err
    with load_run(tmp_path / "smoothed") as paths:
        assert paths.smoothed and not paths.chains and paths.tree["posterior"].sizes["chain"] == len(SEEDS)
    for command in (["report"], ["view"], ["export", "--to", "csv", "--overwrite"], ["picture", "--frame", "2", "--overwrite"]):
        with pytest.raises(SystemExit) as ended:
            main([command[0], str(combined), *command[1:]])
        assert ended.value.code == 0, (command, capsys.readouterr().err)


def test_runs_that_do_not_belong_together_are_refused(singles, combined, looped, tmp_path):
    others = {
        "more particles": {"overrides": {"particles": PARTICLES + 1}, "frames": 2},
        "fewer frames": {"frames": 2},
    }
    for name, settings in others.items():
        run(Settings(looped(FRAMES), tmp_path / name, seed=1, **FILTER | settings), quiet, bar=False)
    shutil.copytree(singles[0], tmp_path / "a copy")
    (tmp_path / "somebody's").mkdir()
    (tmp_path / "somebody's" / "summary.json").write_text("{}")
    for folders, out, said in (
        (
            [singles[0], tmp_path / "more particles"],
            "a",
            r"more particles: does not belong to .*: kernel\.particles is 61, and 60 in the first run; expected",
        ),
        ([singles[0], tmp_path / "fewer frames"], "c", r"fewer frames: 2 frames, where .* has 6"),
        ([singles[0], tmp_path / "a copy"], "d", r"a copy: has the seed 3, as .*run_3; expected another seed in each run"),
        ([singles[0]], "e", "the runs: 1; expected two or more"),
        ([singles[0], combined], "f", "several runs that were put together; expected single runs"),
        ([singles[0], tmp_path / "none"], "g", "no such folder"),
        (singles, "somebody's", "holds summary.json, which a run would replace"),
        (singles, "a copy", "a run of its own; expected a new folder"),
        (singles, singles[0], "expected another folder than those of the runs"),
    ):
        with pytest.raises(InputError, match=said):
            combine_runs(folders, tmp_path / out, quiet, bar=False)
    assert not any((tmp_path / name).exists() for name in "acdefg")
    # A body of another size is another body; another thickness changes no draw.
    other_body = tmp_path / "other body"
    shutil.copytree(singles[1], other_body)
    record = read_run_file(other_body)
    lengths, thickness = {"lengths_m": {"thigh": 0.4}}, {"outline_radii_m": {"thigh": [0.1, 0.1]}}
    for sizes, said in ((lengths, "first_pose: other fitted lengths of the body than"), (thickness, "belongs to another run")):
        write_run_file(other_body, record | {"first_pose": sizes})
        lines = []
        with pytest.raises(InputError, match=said):
            combine_runs([singles[0], other_body], tmp_path / "h", lines.append, bar=False)
        assert bool(lines) == (sizes is thickness) and all("the runs fitted other thicknesses" in line for line in lines)
    with pytest.raises(InputError, match="runs that were put together; expected the run of a filter"):
        run(Settings(looped(FRAMES), combined, resume=True), quiet, bar=False)
