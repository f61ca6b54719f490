"""The real recording, tracked as its users do: the man stays covered in all views, independent runs agree, and so do a mode seeker and a sampler."""

import json
from pathlib import Path

import numpy as np
import pytest

from bayes_body.cli.main import main
from bayes_body.storage.saved_run import load_run, marker_moments

SIZES = ["--particles", "1000", "--runs", "5"]
KERNELS = {"annealed": ["--layers", "5"], "tempered": ["--model", "tempered_smc"]}

pytestmark = pytest.mark.slow


def run(*arguments: object) -> None:
    with pytest.raises(SystemExit) as stopped:
        main([str(each) for each in arguments])
    assert stopped.value.code == 0


@pytest.fixture(scope="module")
def runs(bodytrack, tmp_path_factory) -> dict[str, Path]:
    """Five runs of each kernel."""
    folder = tmp_path_factory.mktemp("runs")
    run("import", "parsec", bodytrack, folder / "walk")
    for kernel, options in KERNELS.items():
        run("track", folder / "walk", "--kernel", kernel, *SIZES, *options, "--out", folder / kernel)
    return {kernel: folder / kernel for kernel in KERNELS}


def summary_of(folder):
    return json.loads((folder / "summary.json").read_text())


@pytest.mark.parametrize("kernel", KERNELS)
def test_five_runs_cover_the_man_and_agree(runs, kernel):
    summary = summary_of(runs[kernel])
    assert summary["frames"] == 4
    assert summary["frames_lost"] == 0
    assert summary["iou_median"] >= 0.66
    assert summary["marker_disagreement_mm"] <= 40


def test_only_the_sampler_estimates_the_evidence(runs):
    assert summary_of(runs["annealed"])["log_evidence"] is None
    sampled = summary_of(runs["tempered"])
    assert sampled["log_evidence_sd"] <= 2
    assert sampled["rhat_share"] >= 0.9


def test_both_find_the_same_man(runs):
    means = []
    for folder in runs.values():
        with load_run(folder) as saved:
            means.append(marker_moments(saved).mean)
    assert np.linalg.norm(means[0] - means[1], axis=-1).mean() <= 0.040
