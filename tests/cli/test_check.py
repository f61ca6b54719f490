"""`bayes-body check`: what it refuses in a sentence, and a whole check, interrupted and gone on with."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest


def test_numbers_outside_their_range_are_refused(cli):
    cli("check", "arm_markers", "--replications", 1).refuses("--replications: 1; expected a whole number from 2 up")
    cli("check", "arm_markers", "--bins", 1).refuses("--bins: 1; expected a whole number from 2 to 200")
    cli("check", "arm_markers", "--frames", 0).refuses("--frames: 0; expected a whole number from 1 up")
    cli("check", "arm_markers", "--jobs", 0).refuses("--jobs: 0")


def test_names_that_do_not_exist_are_refused(cli):
    cli("check", "arm_marker").refuses("model 'arm_marker' does not exist; did you mean 'arm_markers'?")
    cli("check", "arm_markers", "--kernel", "nuts").refuses("kernel 'nuts' does not exist")
    cli("check", "arm_markers", "--kernel", "sir", "--layers", 3).refuses("--layers: the kernel 'sir' has no such option")
    cli("check", "arm_markers", "--rig", "none.toml").refuses("none.toml: no such file")
    cli("check", "arm_markers", "--session", "nowhere").refuses("nowhere", "no such file")


def test_files_without_a_place_are_refused(cli, tmp_path):
    cli("check", "arm_markers", "--json", tmp_path / "no" / "out.json").refuses("--json", "there is no folder", "make the folder")
    cli("check", "arm_markers", "--json", tmp_path).refuses("--json", "a folder; expected a file")
    cli("check", "arm_markers", "--plot", tmp_path / "ranks.txt").refuses("--plot", "the ending '.txt'; expected .png, .pdf or .svg")
    cli("check", "arm_markers", "--session", tmp_path, "--rig", tmp_path / "r.toml").refuses("--rig", "leave one out")


def test_a_likelihood_that_is_no_distribution_is_named_and_what_is_checked_instead(cli):
    cli("check", "arm").refuses("the likelihood 'silhouette_edges': it is not a distribution over images", "give a recording with --session")
    cli("check", "silhouettes").refuses("'silhouette_edges'", "at most 4 dofs for a quadrature, not 31", "coverage_90", "bayes-body simulate")


ARGUMENTS = ["arm_markers", "--kernel", "sir", "--particles", "500", "--replications", "40"]
ARGUMENTS += ["--bins", "5", "--frames", "1", "--jobs", "1", "--seed", "1"]


def _start(*arguments):
    return subprocess.Popen(
        [sys.executable, "-m", "bayes_body.cli.main", "check", *map(str, arguments)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


@pytest.mark.long
@pytest.mark.usefixtures("optimised")
def test_a_right_kernel_passes(cli, tmp_path):
    _whole(cli, tmp_path / "whole.json")


def _whole(cli, path):
    """The figures of a check that was not interrupted."""
    plot = path.with_suffix(".png")
    outcome = cli("check", *ARGUMENTS, "--json", path, "--plot", plot)
    assert outcome.status == 0, outcome.err
    assert "PASS." in outcome.out and plot.exists() and path.with_suffix(".ranks.nc").exists() and not path.with_suffix(".json.partial").exists()
    figures = json.loads(path.read_text())
    assert figures["passed"] and figures["replications"] == 40 and figures["options"]["particles"] == 500
    assert sum(figures["ranks"]["quantities"]["elbow"]["histogram"]) == 40
    return figures


@pytest.mark.long
@pytest.mark.usefixtures("optimised")
def test_an_interrupted_check_goes_on_to_the_same_figures(cli, tmp_path):
    figures, stopped = _whole(cli, tmp_path / "whole.json"), tmp_path / "stopped.json"
    process, partial = _start(*ARGUMENTS, "--json", stopped), tmp_path / "stopped.json.partial"
    while process.poll() is None and (not partial.exists() or len(partial.read_bytes().splitlines()) < 3):
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    assert partial.exists() and not stopped.exists()
    outcome = cli("check", *ARGUMENTS, "--json", stopped)
    assert outcome.status == 0 and "continuing with" in outcome.out + outcome.err
    again = json.loads(stopped.read_text())
    assert {**again, "seconds": 0} == {**figures, "seconds": 0}


@pytest.mark.long
@pytest.mark.usefixtures("optimised")
def test_a_mode_seeker_does_not_pass(cli, tmp_path):
    path = tmp_path / "annealed.json"
    arguments = ("check", "arm_markers", "--kernel", "annealed", "--particles", 500, "--replications", 60, "--json", path)
    outcome = cli(*arguments)
    assert outcome.status == 1
    assert "a mode seeker" in outcome.out and "FAIL." in outcome.out and "the kernel has none that leaves the posterior invariant" in outcome.out
    assert json.loads(path.read_text())["passed"] is False
