"""`bayes-body export`: from a run of the real recording to other programs' files, and sentences about wrong input."""

import ezc3d
import numpy as np
import pytest

from bayes_body.results.storage.saved_moments import marker_moments
from bayes_body.results.storage.saved_run import load_run
from bayes_body.runs.run import run as run_session
from bayes_body.runs.settings import Settings


@pytest.fixture(scope="module")
def run(walk, tmp_path_factory):
    """The folder of a short run."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    settings = Settings(walk, folder, "deutscher_2005", "annealed", {"particles": 50, "layers": 2}, frames=2)
    run_session(settings, show=lambda line: None, bar=False)
    return folder


@pytest.mark.slow
def test_of_a_mode_seeker_means_only_and_why(cli, run, tmp_path):
    outcome = cli("export", run, "--to", "csv", "--out", tmp_path / "walk.csv")
    said = "Means only: the kernel annealed is a mode seeker, and the spread of its particles is not a measure of uncertainty."
    assert outcome.out.splitlines()[1] == said
    columns = (tmp_path / "walk.csv").read_text(encoding="utf-8").splitlines()[0].split(",")
    assert not [name for name in columns if any(moment in name for moment in ("_sd_", "_q05_", "_q95_"))]


def test_the_spread_is_an_option_of_c3d(cli, run, tmp_path):
    cli("export", run, "--to", "csv", "--out", tmp_path / "walk.csv", "--spread").refuses("--spread: with --to csv", "expected c3d")


def test_a_run_s_markers_as_c3d(cli, run):
    outcome = cli("export", run, "--to", "c3d", "--up", "y")
    assert outcome.status == 0, outcome.err
    assert str(run / "motion.c3d") in outcome.out and "15 markers, 2 frames" in outcome.out and "y up" in outcome.out
    c3d = ezc3d.c3d(str(run / "motion.c3d"))
    with load_run(run) as saved:
        mean, fps, up = marker_moments(saved).mean, saved.fps, saved.session.up
    assert c3d["parameters"]["POINT"]["RATE"]["value"] == [fps]
    # A man stands between the floor and two metres, however the world was turned.
    heights = c3d["data"]["points"][1, :15]
    assert np.allclose(heights.T / 1000, mean[..., "xyz".index(up)], atol=1e-5)
    assert heights.min() > -200 and 1300 < heights.max() < 2100


@pytest.mark.parametrize("name", ["trc", *(pytest.param(name, marks=pytest.mark.slow) for name in ("csv", "npz", "bvh"))])
def test_a_name_of_one_s_own_and_overwriting(cli, run, tmp_path, name):
    out = tmp_path / f"walk.{name}"
    assert cli("export", run, "--to", name, "--out", out).status == 0
    assert out.stat().st_size > 0
    cli("export", run, "--to", name, "--out", out).refuses(str(out), "already exists", "--overwrite")
    assert cli("export", run, "--to", name, "--out", out, "--overwrite").status == 0


@pytest.mark.parametrize(
    ("options", "parts"),
    [
        (["--to", "trx"], ["format 'trx' does not exist", "did you mean 'trc'?"]),
        (["--to", "csv", "--up", "w"], ["--up: w", "expected x, y or z"]),
        (["--to", "csv", "--rate", "0"], ["--rate: 0", "above 0"]),
        (["--to", "csv", "--rate", "nan"], ["--rate: nan", "finite"]),
    ],
    ids=["format", "axis", "no rate", "NaN"],
)
def test_options_that_cannot_be_used(cli, run, tmp_path, options, parts):
    cli("export", run, "--out", tmp_path / "out", *options).refuses(*parts)
    assert not list(tmp_path.iterdir())


def test_no_run(cli, tmp_path):
    cli("export", tmp_path / "none", "--to", "csv").refuses(str(tmp_path / "none"), "no such folder")
    cli("export", tmp_path, "--to", "csv").refuses("no run.toml in it", "`bayes-body track`")
