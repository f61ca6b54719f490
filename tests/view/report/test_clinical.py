"""A knee flexed by 60 degrees reads +60 in the table, in OpenSim's motion file and in the report; what no image shows is marked."""

import csv

import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.model.build import body_of
from bayes_body.model.definition import load_definition
from bayes_body.results.storage.saved_run import load_run
from bayes_body.view.export.formats import export
from bayes_body.view.export.motion import read_motion
from bayes_body.view.report.clinical import clinical_section
from bayes_body.view.report.figures import style
from bayes_body.view.report.inspection import Inspection

MODEL = "keypoints"
HEADER = """Coordinates
version=1
nRows=5
nColumns=29
inDegrees=yes

Units are S.I. units (second, meters, Newtons, ...)
If the header above contains a line with 'inDegrees', this indicates whether rotational values are in degrees (yes) or radians (no).

endheader
"""


@pytest.fixture(scope="module")
def walk(make_run):
    """`walk(...)`: a run in which both knees are flexed by 60 degrees on average, the right one with a spread of 4; nobody sees the left foot."""

    def call(**arrays):
        topology = body_of(load_definition(MODEL)).skeleton.topology
        names = topology.dof_names
        pose = np.zeros((2, 61, 5, len(names)))
        pose[..., names.index("l_knee")] = -np.radians(60)
        pose[..., names.index("r_knee")] = -np.radians(60 + 4 * np.linspace(-1, 1, 61) * np.sqrt(3))[:, None]
        # An ankle that is as uncertain as the motion prior leaves it, by 15 degrees, and one that is not.
        pose[..., names.index("l_ankle_y")] = np.radians(15 * np.linspace(-1, 1, 61) * np.sqrt(3))[:, None]
        pose[..., names.index("r_ankle_y")] = np.radians(12 + 4 * np.linspace(-1, 1, 61) * np.sqrt(3))[:, None]
        # The person faces the world's x axis, leans forward by 10 degrees and turns round, half a turn in five frames.
        pose[..., names.index("root_pitch")] = np.radians(10)
        pose[..., names.index("root_yaw")] = np.radians([150, 170, 190, 210, 230])
        pose[..., names.index("root_z")] = 0.9
        return make_run(draws=61, dofs=names, units=topology.dof_units, model=MODEL, pose=pose, **arrays)

    return call


@pytest.mark.slow
def test_a_knee_at_60_degrees(walk, tmp_path, parse):
    with load_run(walk()) as run:
        export(run, "csv", tmp_path / "walk.csv")
        export(run, "npz", tmp_path / "walk.npz")
        export(run, "mot", tmp_path / "walk.mot")
        with style():
            found = parse(clinical_section(Inspection(run)))
    with (tmp_path / "walk.csv").open(encoding="utf-8", newline="") as file:
        row = next(csv.DictReader(file))
    assert {name: float(row[f"knee_flexion_r_{name}_deg"]) for name in ("mean", "sd", "q05", "q95")} == pytest.approx(
        {"mean": 60, "sd": 4, "q05": 60 - 0.9 * 4 * 3**0.5, "q95": 60 + 0.9 * 4 * 3**0.5}, abs=0.15
    )
    assert float(row["knee_flexion_l_mean_deg"]) == pytest.approx(60, abs=1e-3) and float(row["knee_flexion_l_sd_deg"]) < 1e-3
    assert float(row["pelvic_tilt_mean_deg"]) == pytest.approx(10, abs=1e-3)
    # What this body holds fixed is no estimate.
    assert "knee_adduction_r_mean_deg" not in row and "lumbar_bending_mean_deg" not in row
    assert float(row["ankle_dorsiflexion_r_mean_deg"]) == pytest.approx(12, abs=0.1)
    with np.load(tmp_path / "walk.npz") as arrays:
        place = arrays["clinical_names"].tolist().index("knee_flexion_l")
        assert arrays["clinical_q95_deg"][:, place] == pytest.approx(60, abs=1e-3)

    text = (tmp_path / "walk.mot").read_text(encoding="utf-8")
    assert text.startswith(HEADER)
    means, deviations = (columns(tmp_path / name) for name in ("walk.mot", "walk_sd.sto"))
    assert list(means)[:8] == ["time", "pelvis_tilt", "pelvis_list", "pelvis_rotation", "pelvis_tx", "pelvis_ty", "pelvis_tz", "lumbar_extension"]
    assert means["knee_angle_r"] == pytest.approx(60, abs=1e-3) and deviations["knee_angle_r"] == pytest.approx(4, abs=0.1)
    assert means["pelvis_ty"] == pytest.approx(0.9, abs=1e-6) and means["time"] == pytest.approx(np.arange(5) / 60, abs=1e-8)
    # Facing the world's x axis is a quarter turn to the right of OpenSim's x axis, which is the world's y. The turn goes on beyond half a turn.
    assert means["pelvis_rotation"] == pytest.approx(np.array([60, 80, 100, 120, 140]), abs=6)

    knees = [image["alt"] for image in found.of("img") if image["alt"].startswith("Knee flexion over time")]
    ankles = [image["alt"] for image in found.of("img") if image["alt"].startswith("Ankle dorsiflexion over time")]
    assert ankles[0].count("not determined") == 1 and ankles[0].endswith("not determined.") and "left mean from" in ankles[0]
    assert "no measurement: ankle_dorsiflexion_l." in found.text
    assert means["ankle_angle_r"] == pytest.approx(12, abs=0.1) and set(means) >= {"subtalar_angle_r", "subtalar_angle_l", "lumbar_extension"}
    assert knees == ["Knee flexion over time: right mean from 60 to 60 °, widest 90 % band 12.5 °; left mean from 60 to 60 °, widest 90 % band 0 °."]


def columns(path):
    """As OpenSim reads them: what follows `endheader`, by name."""
    head, table = path.read_text(encoding="utf-8").split("endheader\n")
    names, *rows = (line.split("\t") for line in table.splitlines())
    assert f"nRows={len(rows)}\n" in head and f"nColumns={len(names)}\n" in head
    return {name: np.array([float(row[place]) for row in rows]) for place, name in enumerate(names)}


def test_the_direction_a_person_faces_has_no_jumps(walk):
    with load_run(walk()) as run:
        found = read_motion(run).clinical
    turned = found.moments.mean[:, found.names.index("pelvic_rotation")]
    assert np.diff(turned) == pytest.approx(20, abs=1e-2)


@pytest.mark.slow
def test_a_mode_seeker_has_means_only(walk, tmp_path, parse):
    run = walk(log_evidence=np.full((2, 5), np.nan))
    with load_run(run) as saved:
        export(saved, "mot", tmp_path / "walk.mot")
        with style():
            found = parse(clinical_section(Inspection(saved)))
    assert not (tmp_path / "walk_sd.sto").exists()
    assert "no bands" in found.text and "widest" not in " ".join(image["alt"] for image in found.of("img"))


@pytest.mark.slow
def test_opensim_wants_y_up_and_a_pelvis(walk, make_run, tmp_path):
    with load_run(walk()) as run, pytest.raises(InputError, match="--up: z with --to mot; expected y"):
        export(run, "mot", tmp_path / "walk.mot", up="z")
    arm = make_run(dofs=("shoulder_x", "shoulder_y", "shoulder_z", "elbow"), units=("rad",) * 4)
    with load_run(arm) as run, pytest.raises(InputError, match="no anatomical axes of a pelvis"):
        export(run, "mot", tmp_path / "arm.mot")
    assert not list(tmp_path.iterdir())
