"""Keypoints that are read while they are written: the same as after an import, and which files are waited for."""

import threading
from dataclasses import replace

import numpy as np
import pytest
import tomlkit
from pose_estimator import PoseEstimator

from bayes_body.base.errors import InputError
from bayes_body.recording.observation.frames import read_frame
from bayes_body.recording.readers.keypoints import arriving
from bayes_body.recording.session.read import FILE_NAME, load_session, save_session
from bayes_body.recording.session.session import Span

# Seconds: longer than any test, so that no outcome depends on the clock.
ENDLESS_S = 1e4


@pytest.fixture
def estimator(textured_session, tmp_path, monkeypatch):
    """A pose estimator that has written one frame of five, whose session has that frame."""
    monkeypatch.setattr(arriving, "LATE_S", ENDLESS_S)
    for view in textured_session.views:
        (tmp_path / "session" / view.camera.name).parent.mkdir(exist_ok=True)
        (tmp_path / "session" / view.camera.name).symlink_to(textured_session.folder / view.camera.name)
    estimator = PoseEstimator(textured_session, tmp_path / "pose")
    estimator.write(range(1))
    save_session(estimator.imported(tmp_path / "session", 1))
    return estimator


def read(estimator, frames):
    """What is read of so many frames: (frames, keypoints of each, the reader)."""
    session = load_session(estimator.folder.parent / "session")
    with arriving.arriving_keypoints(session, estimator.folder, ENDLESS_S) as reader:
        arrived = [reader.wait_for(frame) for frame in range(frames)]
        return arrived, [reader.keypoints(frame) for frame, entry in enumerate(arrived) if entry is not None], reader


def test_frames_that_come_are_those_of_an_import(estimator, tmp_path):
    writer = threading.Thread(target=estimator.write, args=(range(1, 5),))
    writer.start()
    arrived, keypoints, reader = read(estimator, 5)
    writer.join()
    file = tmp_path / "session" / FILE_NAME
    file.write_text(file.read_text().replace("frames = 1", "frames = 1  # so far"))
    reader.extend_session(file)
    imported, extended = estimator.imported(tmp_path / "imported", 5), load_session(file)
    assert [entry.visibility for entry in arrived] == [(True, True)] * 5
    for view, same in zip(imported.views, extended.views, strict=True):
        written, expected = (np.load(path) for path in (extended.keypoints_path(same), imported.keypoints_path(view)))
        assert {name: values.tobytes() for name, values in written.items()} == {name: values.tobytes() for name, values in expected.items()}
    assert extended.frames == 5 and "# so far" in file.read_text()
    assert keypoints == [read_frame(extended, frame).keypoints for frame in range(5)]
    assert all(len(points) > 10 for frame in keypoints for points in frame)
    # It is not shortened, and a range of a recording grows with the recording.
    reader.extend_session(file)
    text = tomlkit.parse(file.read_text())
    text["frames"], text["recorded"] = 2, [0, 3]
    file.write_text(tomlkit.dumps(text))
    reader.session = replace(extended, frames=2)
    reader.extend_session(file)
    assert (load_session(file).frames, load_session(file).recorded) == (5, (0, 5))


def test_a_camera_that_has_gone_on_is_not_waited_for(estimator):
    estimator.write(range(1, 5))
    first, second = estimator.session.views
    estimator.path(first, 2).unlink()
    # Frame 3 comes from no camera; both have a later one.
    for view in (first, second):
        estimator.path(view, 3).unlink()
    arrived, keypoints, reader = read(estimator, 5)
    assert [entry.visibility for entry in arrived] == [(True, True), (True, True), (False, True), (False, False), (True, True)]
    assert keypoints[2][0] is None and keypoints[3] == (None, None) and reader.missing(range(5)) == {"a": 2, "b": 1}


def test_a_camera_that_stops_is_waited_for_once(estimator, monkeypatch):
    # Every frame of the first camera is there, none of the second one: after the first wait, each frame goes on without it.
    monkeypatch.setattr(arriving, "LATE_S", 0.05)
    estimator.write(range(1, 5))
    for frame in range(1, 5):
        estimator.path(estimator.session.views[1], frame).unlink()
    # A file that is never completed is no file; the frames after it are read.
    path = estimator.path(estimator.session.views[0], 4)
    path.write_text(path.read_text()[:50])
    arrived, _, _ = read(estimator, 5)
    assert [entry.visibility for entry in arrived] == [(True, True), (True, False), (True, False), (True, False), (False, False)]


def test_the_recording_ends_when_no_file_comes(estimator):
    session = load_session(estimator.folder.parent / "session")
    with arriving.arriving_keypoints(session, estimator.folder, ENDLESS_S) as reader:
        assert reader.wait_for(0) is not None
        reader.wait_s = 0.2
        assert reader.wait_for(1) is None and reader.end == "no new file came for 0.2 s"


def test_what_cannot_be_keypoints_of_the_session_is_refused(estimator, tmp_path):
    session = load_session(tmp_path / "session")
    path = estimator.path(session.views[0], 1)
    for text, problem in (
        ('{"people": [{"pose_keypoints_2d": [1, 2, 0.5]}]}', "people with 1 keypoints; expected 17, as in the session's keypoints"),
        ('{"persons": []}', "no list `people`"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=problem):
            read(estimator, 2)
    path.unlink()
    with pytest.raises(InputError, match="its cameras have no keypoints; expected keypoints in one order; import the recording when"):
        arriving.ArrivingKeypoints(replace(session, views=tuple(replace(view, keypoints=None) for view in session.views)), estimator.folder, 1.0)
    paired = tuple(replace(view, spans=(Span(0, 0, 4), Span(6, 4, 9))) for view in session.views)
    with pytest.raises(InputError, match=r"camera 'a' has `spans`: .*; expected a camera whose frame k is file k"):
        arriving.ArrivingKeypoints(replace(session, views=paired), estimator.folder, 1.0)
    (estimator.folder / "b_json").rename(estimator.folder / "c_json")
    with pytest.raises(InputError, match="no folder of camera 'b'; expected a folder CAMERA_json"):
        read(estimator, 1)
