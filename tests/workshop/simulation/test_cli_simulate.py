"""`bayes-body simulate` in-process, its picture of the first pose left out: what it reads, writes and refuses."""

import numpy as np
import pytest
import typer
from typer.testing import CliRunner
from workshop.simulation.walker import FPS, walker

from bayes_body.base.errors import InputError
from bayes_body.cli import simulate as verb
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.readers.images import read_mask
from bayes_body.recording.readers.keypoints.openpose import read_people
from bayes_body.recording.readers.truth import read_truth
from bayes_body.recording.session.read import load_session
from bayes_body.workshop.simulation.staging import stature_m


@pytest.fixture
def run(monkeypatch):
    """The command's output; an error is raised as it is."""
    app = typer.Typer()
    app.command()(verb.simulate)
    drawn = []
    monkeypatch.setattr(verb, "_draw", lambda session, folder: drawn.append(folder))

    def call(*arguments):
        outcome = CliRunner().invoke(app, [str(argument) for argument in arguments])
        if outcome.exception and not isinstance(outcome.exception, SystemExit):
            raise outcome.exception
        assert outcome.exit_code == 0, outcome.output
        assert drawn
        return outcome.output

    return call


@pytest.fixture(scope="module")
def trc(tmp_path_factory):
    """The walker as a file of a marker system, millimetres, twice the cameras' rate, away from the origin."""
    landmarks = walker(24, fps=2 * FPS)
    path = tmp_path_factory.mktemp("mocap") / "walker.trc"
    head = f"{2 * FPS:g}\t{2 * FPS:g}\t24\t{len(MARKERS)}\tmm\t{2 * FPS:g}\t1\t24"
    names = "Frame#\tTime\t" + "\t\t\t".join(MARKERS)
    axes = "\t\t" + "\t".join(f"X{k}\tY{k}\tZ{k}" for k in range(1, len(MARKERS) + 1))
    rows = []
    for frame in range(24):
        # y up, as this format usually has it: (x, y, z) of z up is (y, z, x).
        places = [1000 * (landmarks[name][frame] + (5.0, -3.0, 0.0))[[1, 2, 0]] for name in MARKERS]
        rows.append(f"{frame + 1}\t{frame / (2 * FPS):.6f}\t" + "\t".join(f"{value:.5f}" for place in places for value in place))
    kinds = "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames"
    path.write_text("\n".join([f"PathFileType\t4\t(X/Y/Z)\t{path.name}", kinds, head, names, axes, "", *rows]) + "\n")
    return path


def test_a_captured_motion_becomes_a_session(run, trc, tmp_path):
    out = tmp_path / "s"
    said = run(trc, "--out", out, "--rig", "room_4", "--cameras", "C1,C3", "--first-frame", 2, "--frames", 6, "--clutter", 0.2, "--height", 1.9)
    assert "2 cameras, 6 frames at 60 frames a second, a person of 1.90 m" in said
    session = load_session(out)
    assert [view.camera.name for view in session.views] == ["C1", "C3"]
    assert session.title == "walker, simulated with room_4"
    markers = read_truth(session.truth_path, 6)
    whole = walker(24, fps=2 * FPS)
    factor = 1.9 / stature_m(whole)
    wanted = factor * np.stack([whole[name][4:16:2] for name in MARKERS], axis=1)
    wanted[..., :2] -= (wanted[:, 0].min(axis=0) + wanted[:, 0].max(axis=0))[:2] / 2
    np.testing.assert_allclose(markers, wanted, atol=2e-5)


def test_the_walk_that_ships_is_filmed(run, tmp_path):
    run("walk", "--out", tmp_path / "s", "--rig", "side_1", "--frames", 4, "--clutter", 0, "--subject", "anna", "--segmentation", "good")
    session = load_session(tmp_path / "s")
    assert session.frames == 4 and session.views[0].masks is not None
    markers = read_truth(session.truth_path, 4)
    assert 1.3 < markers[:, -1, 2].mean() < 2.1
    assert 0.3 < np.linalg.norm(markers[3, 0] - markers[0, 0]) * 20 < 2.5


def test_two_people_hide_each_other_and_the_detector_sees_who_is_in_front(run, tmp_path):
    """From C1 the first person hides one who is right behind; from C2 both are seen."""
    out = tmp_path / "s"
    run("walk", "--out", out, "--cameras", "C1,C2", "--frames", 2, "--clutter", 0, "--masks", "--keypoints", "--with", "walk:0@-0.68,-0.577")
    assert read_truth(out / "truth_person_2.npz", 2).shape == read_truth(out / "truth.npz", 2).shape
    counts = {}
    for name in ("C1", "C2"):
        first, everyone = (read_mask(out / kind / name / "000001.png") for kind in ("true_masks", "true_masks_of_all"))
        assert (everyone | ~first).all()
        people = read_people(out / "pose" / f"{name}_json" / f"{name}_000000000001_keypoints.json")
        counts[name] = everyone.sum() / first.sum(), np.isfinite(people[..., 0]).sum()
    assert counts["C1"][0] < 1.5 < counts["C2"][0]
    assert counts["C1"][1] < 25 < counts["C2"][1] == 30


def test_a_name_is_always_the_same_person():
    assert verb._seed_of("12") == 12
    assert verb._seed_of("anna") == verb._seed_of("anna") != verb._seed_of("Anna")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--rig", "room_5"), "--rig: 'room_5' is neither a rig that ships nor a file; did you mean 'room_4'?"),
        (("--cameras", "C1,C7"), "rig room_4: camera 'C7': no such camera"),
        (("--segmentation", "god"), "--segmentation: there is no segmenter 'god'; did you mean 'good'?"),
        (("--frames", "99"), "--frames: 99; expected 1 to 12"),
        (("--frames", "1000000000"), "--frames: 1000000000; expected at most 100000"),
        (("--first-frame", "12"), "--first-frame: 12; expected 0 to 11"),
        (("--height", "18"), "height: 18 m"),
        (("--noise", "9"), "--noise: 9; expected 0 to 5"),
        (("--no-centre",), "camera 'C1': sees the person in 0 of 12 frames; expected a camera that sees the person, who is around (5."),
        (("--with", "walk@here"), "--with walk@here: 'here' is not a place; expected MOTION[:SUBJECT][@X,Y[,DEGREES]]"),
        (("--with", ":3"), "--with :3: no motion"),
        (("--background", "nowhere"), "--background nowhere: no image or video for camera 'C1'"),
    ],
)
def test_what_is_wrong_is_said_before_anything_is_written(run, trc, tmp_path, arguments, said):
    with pytest.raises(InputError) as error:
        run(trc, "--out", tmp_path / "s", *arguments)
    assert said in str(error.value)
    assert not (tmp_path / "s" / "session.toml").exists()


def test_a_session_is_not_written_over(run, trc, tmp_path):
    (tmp_path / "session.toml").write_text("")
    with pytest.raises(InputError, match=r"already holds a session.toml"):
        run(trc, "--out", tmp_path)
