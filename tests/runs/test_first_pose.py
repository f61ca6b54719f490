"""A run without a first pose, with one that does not fit, and one whose body loses the person."""

import dataclasses
import json

import cv2
import numpy as np
import pytest
from keypoint_walks import Network, person_of, shipped_walk, walk_session

from bayes_body.base.errors import InputError
from bayes_body.model.build import build_model
from bayes_body.recording.readers.keypoints.candidates import Bystanders
from bayes_body.recording.readers.keypoints.series import KeypointSeries, write_series
from bayes_body.recording.readers.keypoints.triangulate import project
from bayes_body.recording.session.read import load_session, save_session
from bayes_body.results.metrics.fit import projected_masks
from bayes_body.results.metrics.plausibility import first_fit
from bayes_body.results.metrics.plausibility_sentences import fit_sentences
from bayes_body.results.posterior import markers
from bayes_body.results.storage.saved_run import load_run
from bayes_body.runs import run as module
from bayes_body.runs.run import run
from bayes_body.runs.settings import Settings
from bayes_body.view.report.inspection import Inspection

SMALL = {"model": "arm", "overrides": {"particles": 200}}


@pytest.fixture
def arm_session(textured_session, tmp_path):
    """`arm_session(shift=lambda frame: 0)`: silhouettes of the arm in its first pose, moved sideways by pixels."""

    def make(shift):
        folder = tmp_path / "session"
        views, pose = [], np.asarray(build_model("arm", textured_session).initial["pose"])
        masks = projected_masks(build_model("arm", textured_session), pose, textured_session)
        for view, mask in zip(textured_session.views, masks, strict=True):
            (folder / view.camera.name).mkdir(parents=True)
            for frame in range(textured_session.frames):
                source = textured_session.image_path(view, frame)
                (folder / view.camera.name / source.name).symlink_to(source)
                moved = np.roll(mask, shift(frame), axis=1).astype(np.uint8) * 255
                cv2.imwrite(str(folder / view.camera.name / f"mask{frame:04d}.png"), moved)
            views.append(dataclasses.replace(view, masks=f"{view.camera.name}/mask%04d.png"))
        session = dataclasses.replace(textured_session, folder=folder, views=tuple(views))
        save_session(session)
        return session

    return make


def _run(session, out):
    lines = []
    summary = run(Settings(session.folder, out, **SMALL), lines.append, bar=False)
    return summary, lines


def test_without_a_first_pose_nothing_is_compiled(textured_session, tmp_path, monkeypatch):
    session = dataclasses.replace(textured_session, folder=tmp_path / "session")
    save_session(session)

    def compiled(*arguments, **options):
        raise AssertionError("compiled before the first pose was checked")

    for name in ("compiled_ahead", "track", "first_fit"):
        monkeypatch.setattr(module, name, compiled)
    with pytest.raises(
        InputError,
        match=r"session\.toml: initial: no first pose, and no person was detected .* origin of the world; expected .* import .* --keypoints",
    ):
        run(Settings(session.folder, tmp_path / "run", model="deutscher_2005"), print, bar=False)
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_a_first_pose_that_fits_raises_no_warning(arm_session, tmp_path):
    summary, lines = _run(arm_session(lambda frame: 0), tmp_path / "run")
    assert summary["fit_by"] == "silhouettes" and summary["fit_first"] > 0.95 and summary["frames_off"] == []
    assert not any("first pose" in line or "covers the person" in line for line in lines)


def test_a_first_pose_that_does_not_fit_is_a_warning_before_the_tracking_and_at_the_end(arm_session, tmp_path):
    summary, lines = _run(arm_session(lambda frame: 50), tmp_path / "run")
    said = [place for place, line in enumerate(lines) if line.startswith("warning") and "the body in its first pose does not fit the image" in line]
    figures = next(place for place, line in enumerate(lines) if line.startswith("frames "))
    assert len(said) == 2 and said[0] < figures < said[1]
    assert f"{summary['fit_first']:.2f} (limit 0.7" in lines[said[0]]
    assert summary["fit_first"] < 0.7 and summary["warnings"][0] in lines[said[1]]


def test_where_nothing_tells_whether_the_body_is_on_the_person_the_user_reads_so(textured_session):
    views = tuple(dataclasses.replace(view, masks=None) for view in textured_session.views)
    lines = []
    module._show_first_fit(dataclasses.replace(textured_session, views=views), build_model("arm", textured_session), lines.append)
    (line,) = lines
    assert line.startswith("note: neither silhouettes nor keypoints tell")


@pytest.mark.slow
def test_a_body_that_loses_the_person_is_a_warning_from_that_frame_on(arm_session, tmp_path):
    summary, lines = _run(arm_session(lambda frame: 50 * (frame >= 2)), tmp_path / "run")
    assert summary["fit_first"] > 0.95 and summary["frames_off"] == [2, 3, 4] and summary["fit_worst"] < 0.7
    (sentence,) = [each for each in summary["warnings"] if "covers the person" in each]
    assert sentence.startswith("from frame 2 the body no longer covers the person") and any(sentence in line for line in lines)
    assert json.loads((tmp_path / "run" / "summary.json").read_text(encoding="utf-8"))["warnings"] == summary["warnings"]
    with load_run(tmp_path / "run") as saved:
        assert sentence in Inspection(saved).warnings
    assert not any(line.startswith("look at") for line in lines)


@pytest.mark.parametrize(("metres", "warned"), [(0.0, False), (0.25, True)])
def test_of_a_real_recording(bodytrack, tmp_path, metres, warned):
    from bayes_body.recording.readers.parsec import import_parsec

    import_parsec(bodytrack, tmp_path)
    session = load_session(tmp_path)
    moved = dataclasses.replace(session, initial={**session.initial, "root_x": session.initial["root_x"] + metres})
    assert bool(fit_sentences(first_fit(moved, build_model("silhouettes", moved)))) == warned


def test_a_first_pose_of_another_person_says_so(tmp_path):
    walk, _ = walk_session(tmp_path, person_of(shipped_walk(2, 0), False), Network(), ["C1", "C2"])
    session = dataclasses.replace(walk, initial={"root_z": 0.95}, initial_keypoints={}, fit_lengths=False)
    model = build_model("deutscher_2005", session)
    names = tuple(model.body.markers.names)
    body_m = np.asarray(markers(model, np.asarray(model.initial["pose"])[None]))[0]
    confidence = np.full((len(names), 1), 0.9)
    said = {}
    for subject_px, stranger_px in ((0.0, 120.0), (120.0, 0.0), (120.0, -120.0)):
        for view in session.views:
            points = np.hstack([project(view.camera, body_m), confidence])
            subject, stranger = (np.add(points, (shift, 0.0, 0.0))[None] for shift in (subject_px, stranger_px))
            series = KeypointSeries(subject, names, 0, bystanders=Bystanders(stranger, np.ones(1, int)))
            write_series(session.keypoints_path(view), series)
        figures = first_fit(session, model)
        said[subject_px, stranger_px] = fit_sentences(figures | {"first_frame": 7}), figures.get("fit_bystander"), figures["fit_first"]
    # On the subject there is nothing to say, whoever else is there.
    nothing, distance, fit = said[0.0, 120.0]
    assert nothing == [] and distance is None and fit < 0.01
    (wrong,), distance, fit = said[120.0, 0.0]
    assert wrong.startswith("frame 7: the first pose is that of another person: it is 0.00 of a person's size in the image away from that person's")
    assert distance < 0.01 < 0.5 < fit and wrong.endswith("remove the first pose from the session, or track the other person with --person.")
    # On nobody it is not said to be on somebody.
    (nobody,), distance, _ = said[120.0, -120.0]
    assert distance is None and "does not fit the image" in nobody
