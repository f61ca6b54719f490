"""The real recording, tracked as its users do: the man stays covered in all views, independent runs agree, and so do a mode seeker and a sampler."""

import json
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from bayes_body.cli.main import main
from bayes_body.results.storage.saved_moments import marker_moments
from bayes_body.results.storage.saved_run import load_run

SIZES = ["--particles", "1000", "--runs", "5"]
KERNELS = {"annealed": ["--layers", "5"], "tempered": ["--model", "silhouettes"]}

pytestmark = pytest.mark.usefixtures("optimised")

EACH_KERNEL = [pytest.param("annealed", marks=pytest.mark.slow), pytest.param("tempered", marks=pytest.mark.long)]


def run(*arguments: object) -> None:
    with pytest.raises(SystemExit) as stopped:
        main([str(each) for each in arguments])
    assert stopped.value.code == 0


@pytest.fixture(scope="module")
def runs(bodytrack, tmp_path_factory) -> Callable[[str], Path]:
    """`runs("annealed")`: the folder of five runs of a kernel, made when it is first asked for."""
    folder = tmp_path_factory.mktemp("runs")
    run("import", "parsec", bodytrack, folder / "walk")

    @cache
    def made(kernel):
        run("track", folder / "walk", "--kernel", kernel, *SIZES, *KERNELS[kernel], "--out", folder / kernel)
        return folder / kernel

    return made


def summary_of(folder):
    return json.loads((folder / "summary.json").read_text())


@pytest.mark.parametrize("kernel", EACH_KERNEL)
def test_five_runs_cover_the_man_and_agree(runs, kernel):
    summary = summary_of(runs(kernel))
    assert summary["frames"] == 4
    assert summary["frames_lost"] == 0
    assert summary["iou_median"] >= 0.66
    assert summary["marker_disagreement_mm"] <= 40


@pytest.mark.slow
def test_a_mode_seeker_estimates_no_evidence(runs):
    assert summary_of(runs("annealed"))["log_evidence"] is None


@pytest.mark.long
def test_the_sampler_estimates_the_evidence_and_its_runs_agree(runs):
    sampled = summary_of(runs("tempered"))
    assert sampled["log_evidence_sd"] <= 2
    assert sampled["rhat_share"] >= 0.9


@pytest.mark.long
def test_both_find_the_same_man(runs):
    means = []
    for kernel in KERNELS:
        with load_run(runs(kernel)) as saved:
            means.append(marker_moments(saved).mean)
    assert np.linalg.norm(means[0] - means[1], axis=-1).mean() <= 0.040
