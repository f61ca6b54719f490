"""`bayes-body gait`: a table and a file of a smoothed run, and a sentence for every other."""

import csv
import re

import numpy as np
import pytest

from bayes_body.clinical.gait import CONTACT
from bayes_body.model.build import body_of
from bayes_body.model.definition import load_definition
from bayes_body.storage.saved_run import SavedRun, load_run
from bayes_body.view.report.gait import gait_section
from bayes_body.view.report.inspection import Inspection


def stepping(frames=150):
    """A person of the model `markers_31` who walks along y: poses (2, 20, frame, dof); the hips swing, the knees are straight."""
    body = body_of(load_definition("markers_31"))
    rng, t = np.random.default_rng(0), np.arange(frames) / 60
    pose = np.zeros((2, 20, frames, len(body.dof_names)))
    at = {name: place for place, name in enumerate(body.dof_names)}
    pose[..., at["root_yaw"]] = np.pi / 2
    pose[..., at["root_y"]] = 1.2 * t + 0.01 * rng.normal(size=(2, 20, 1))
    pose[..., at["l_hip_y"]] = 0.4 * np.cos(2 * np.pi * t / 1.0)
    pose[..., at["r_hip_y"]] = -0.4 * np.cos(2 * np.pi * t / 1.0)
    return pose


def test_the_command_prints_a_table_and_writes_all_strides(make_run, cli, monkeypatch):
    folder = make_run(model="markers_31", draws=20, frames=150, pose=stepping(), log_weight=np.zeros((2, 20, 150)))
    cli("gait", folder).refuses("a smoothed run", f"smooth it first with `bayes-body smooth {folder}`")
    assert not (folder / "gait.csv").exists()
    monkeypatch.setattr(SavedRun, "smoothed", True, raising=False)
    outcome = cli("gait", folder)
    assert outcome.status == 0, outcome.err
    assert re.search(r"cadence +steps/min +12\d\.\d|cadence +steps/min +11\d\.\d", outcome.out) and "toe off" in outcome.out
    with (folder / "gait.csv").open(encoding="utf-8", newline="") as file:
        rows = {(row["quantity"], row["side"], row["number"]): row for row in csv.DictReader(file)}
    assert float(rows["stride_length", "r", "1"]["mean"]) == pytest.approx(1.2, abs=0.02)
    assert float(rows["stride_time", "", "0"]["mean"]) == pytest.approx(1.0, abs=0.01)
    # The right leg is ahead half a stride after the left one.
    assert float(rows["foot_strike", "r", "1"]["mean"]) == pytest.approx(0.5 - CONTACT.mean, abs=0.02)
    assert 0 < float(rows["foot_strike", "r", "1"]["sd"]) < 0.05
    cli("gait", folder).refuses("gait.csv", "already exists", "--overwrite")
    with load_run(folder) as run:
        page = gait_section(Inspection(run))
    assert (
        "cadence" in page
        and f"{float(rows['speed', '', '0']['mean']):.3f}" in page
        and page.count("toe off") == sum("toe_off" in key for key in rows)
    )


def test_a_body_without_feet_has_no_gait(make_run, cli, monkeypatch):
    monkeypatch.setattr(SavedRun, "smoothed", True, raising=False)
    cli("gait", make_run()).refuses("no marker l_hip, r_hip, l_ankle, r_ankle")
