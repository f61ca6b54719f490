"""`bayes-body gait`: a table and a file of a smoothed run, and a sentence for every other."""

import csv
import re

import ezc3d
import numpy as np
import pytest

import bayes_body.cli.gait as gait_command
from bayes_body.model.build import body_of
from bayes_body.model.definition import load_definition
from bayes_body.recording.readers.mocap.c3d import _text, open_c3d
from bayes_body.results.clinical.gait import CONTACT, Event
from bayes_body.results.storage.saved_run import SavedRun, load_run
from bayes_body.view.export.c3d import add_events
from bayes_body.view.report import gait as gait_report
from bayes_body.view.report.gait import gait_section
from bayes_body.view.report.inspection import Inspection


def stepping(frames=150):
    """A person of the model `keypoints` who walks along y: poses (2, 20, frame, dof); the hips swing, the knees are straight."""
    body = body_of(load_definition("keypoints"))
    rng, t = np.random.default_rng(0), np.arange(frames) / 60
    pose = np.zeros((2, 20, frames, len(body.dof_names)))
    at = {name: place for place, name in enumerate(body.dof_names)}
    pose[..., at["root_yaw"]] = np.pi / 2
    pose[..., at["root_y"]] = 1.2 * t + 0.01 * rng.normal(size=(2, 20, 1))
    pose[..., at["l_hip_y"]] = 0.4 * np.cos(2 * np.pi * t / 1.0)
    pose[..., at["r_hip_y"]] = -0.4 * np.cos(2 * np.pi * t / 1.0)
    return pose


@pytest.mark.slow
def test_the_command_prints_a_table_and_writes_all_strides(make_run, cli, monkeypatch):
    folder = make_run(model="keypoints", draws=20, frames=150, pose=stepping(), log_weight=np.zeros((2, 20, 150)))
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
    check_ranges(rows, outcome.out)
    check_exports(cli("export", folder, "--to", "mot,csv,c3d"), folder, rows)
    with load_run(folder) as run:
        page = gait_section(Inspection(run))
    assert (
        "cadence" in page
        and f"{float(rows['speed', '', '0']['mean']):.3f}" in page
        and page.count("toe off") == sum("toe_off" in key for key in rows)
    )
    # A long recording has thousands of events: the file has all of them.
    events = sum(key[0] in ("foot_strike", "toe_off") for key in rows)
    monkeypatch.setattr(gait_command, "MOST_ROWS", 3)
    monkeypatch.setattr(gait_report, "MOST_EVENTS", 3)
    assert f"... and {events - 3} more events: {folder / 'gait.csv'} has all." in " ".join(cli("gait", folder, "--overwrite").out.split())
    with load_run(folder) as run:
        page = gait_section(Inspection(run))
    assert f"the first 3 of {events} events" in page and page.count("toe off") < 4 and f"writes all {events} events" in page


def check_ranges(rows, printed):
    """The hips swing by 0.4 to both sides, in every draw alike; a filter at 6 Hz leaves that as it is."""
    swing = np.degrees(0.4)
    for side in "lr":
        for number in ("0", "1"):
            largest, smallest, extent = (rows[f"hip_flexion_{name}", side, number] for name in ("max", "min", "range"))
            assert float(extent["mean"]) == pytest.approx(2 * swing, abs=0.5) and float(extent["sd"]) < 0.01 and extent["unit"] == "deg"
            assert float(largest["mean"]) - float(smallest["mean"]) == pytest.approx(float(extent["mean"]), abs=1e-5)
    # A stride has the angles of its side, and those of the middle.
    assert ("pelvic_tilt_max", "r", "1") in rows and ("pelvic_tilt_max", "", "0") in rows
    assert re.search(r"hip flexion +right +\S+ \(\S+ to \S+\)", printed)


def check_exports(outcome, folder, rows):
    """Three formats in one call, with the gait's events and the quantiles of OpenSim's coordinates."""
    assert outcome.status == 0, outcome.err
    lines = outcome.out.splitlines()
    mot = [folder / "motion.mot", *(folder / f"motion_{name}.sto" for name in ("sd", "q05", "q50", "q95"))]
    assert lines[-7:] == [*map(str, mot), str(folder / "motion.csv"), str(folder / "motion.c3d")]
    assert "150 frames at 60 a second, y up (mot), z up (csv, c3d)" in lines[0]
    tables = [np.genfromtxt(file, names=True, skip_header=10) for file in mot]
    assert all(file.read_text().startswith("Coordinates\nversion=1\n") for file in mot)
    _, sd, low, middle, high = (table["pelvis_tx"] for table in tables)
    assert (low < middle).all() and (middle < high).all() and (sd > 0).all()
    content, parameters = open_c3d(folder / "motion.c3d", (folder / "motion.c3d").read_bytes())
    events = [row for (quantity, _, _), row in rows.items() if quantity in ("foot_strike", "toe_off")]
    assert parameters["EVENT:USED"] == len(events) > 6 and parameters["EVENT:USED"].dtype == np.int16 and content.processor
    read = {name: _text(parameters, f"EVENT:{name}") for name in ("CONTEXTS", "LABELS", "DESCRIPTIONS")}
    sides, kinds = {"l": "Left", "r": "Right"}, {"foot_strike": "Foot Strike", "toe_off": "Foot Off"}
    assert read["CONTEXTS"] == [sides[row["side"]] for row in events] and read["LABELS"] == [kinds[row["quantity"]] for row in events]
    # Minutes and seconds from the first frame.
    np.testing.assert_allclose(parameters["EVENT:TIMES"], [[0.0] * len(events), [float(row["mean"]) for row in events]], atol=1e-5)
    assert read["DESCRIPTIONS"][0].startswith(f"sd {1000 * float(events[0]['sd']):.0f} ms, 90 % ")
    assert _text(parameters, "EVENT_CONTEXT:LABELS") == ["Left", "Right"]
    # The other reader agrees.
    assert ezc3d.c3d(str(folder / "motion.c3d"))["parameters"]["EVENT"]["LABELS"]["value"] == read["LABELS"]


def test_more_events_than_a_parameter_holds_go_on_in_the_next(tmp_path):
    events = [Event("toe off" if k % 2 else "foot strike", "lr"[k % 4 // 2], np.array([0.5 * k])) for k in range(300)]
    c3d = ezc3d.c3d()
    c3d["parameters"]["POINT"]["LABELS"]["value"], c3d["parameters"]["POINT"]["RATE"]["value"] = ["knee"], [60.0]
    c3d["data"]["points"] = np.ones((4, 1, 3))
    add_events(c3d, [*events, Event("toe off", "l", np.array([1.0, np.nan, np.nan]))])
    c3d.write(str(tmp_path / "events.c3d"))
    _, parameters = open_c3d(tmp_path / "events.c3d", (tmp_path / "events.c3d").read_bytes())
    # What fewer than half of the draws have is not written.
    assert parameters["EVENT:USED"] == 300
    minutes, seconds = np.concatenate([parameters["EVENT:TIMES"], parameters["EVENT:TIMES2"]], axis=1)
    np.testing.assert_allclose(60 * minutes + seconds, 0.5 * np.arange(300), atol=1e-4)
    assert (seconds < 60).all() and minutes[-1] == 2
    assert [*_text(parameters, "EVENT:LABELS"), *_text(parameters, "EVENT:LABELS2")] == ["Foot Strike", "Foot Off"] * 150


def test_a_body_without_feet_has_no_gait(make_run, cli, monkeypatch):
    monkeypatch.setattr(SavedRun, "smoothed", True, raising=False)
    cli("gait", make_run()).refuses("no marker l_hip, r_hip, l_ankle, r_ankle")
