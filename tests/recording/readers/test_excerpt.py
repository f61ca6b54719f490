"""A range of a recording's frames: the same frames under the same numbers, with everything that belongs to them."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from bayes_body.base.errors import FaultyFileError, InputError
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.observation.frames import read_frame
from bayes_body.recording.observation.silhouettes import background_of, has_silhouettes
from bayes_body.recording.readers.camera_path import cameras_at
from bayes_body.recording.readers.excerpt import excerpt
from bayes_body.recording.session.read import load_session, save_session
from bayes_body.recording.session.session import CameraSpec, Session, View
from bayes_body.results.metrics.truth import true_markers

FRAMES, FIRST = 12, 100


@pytest.fixture
def recording(tmp_path):
    """Twelve images of two cameras, numbered from 100 and from 103, with a first pose, a truth, and a path of the second camera."""
    views = []
    for name, offset in (("a", 0), ("b", 3)):
        (tmp_path / name).mkdir()
        for k in range(FRAMES):
            image = np.random.default_rng(k).integers(0, 20 * k + 20, (48, 64), np.uint8)
            cv2.imwrite(str(tmp_path / name / f"{FIRST + offset + k}.png"), image)
        spec = CameraSpec(name, (64, 48), (60.0, 60.0), (32.0, 24.0), 0.0, (0.0,) * 5, np.eye(3), np.zeros(3))
        views.append(View(spec, images=f"{name}/%d.png", offset=offset, path="path.npz" if name == "b" else None))
    np.savez(tmp_path / "path.npz", rotation=np.tile(np.eye(3), (FRAMES, 1, 1)), translation_m=np.arange(3.0 * FRAMES).reshape(FRAMES, 3))
    truth = np.broadcast_to(np.arange(float(FRAMES))[:, None, None], (FRAMES, 15, 3))
    np.savez(tmp_path / "truth.npz", markers=truth, names=np.array(MARKERS))
    initial = {"root_z": 1.0}
    return Session(tmp_path, "t", "z", 30.0, FRAMES, FIRST, tuple(views), initial=initial, positions=frozenset(initial), truth="truth.npz")


def test_it_has_the_frames_of_these_numbers(recording):
    part = excerpt(recording, 104, 5)
    assert [part.frame_number(k) for k in range(part.frames)] == [104, 105, 106, 107, 108]
    assert [part.number(view, 0) for view in part.views] == [104, 107]
    for k in range(5):
        now, whole = read_frame(part, k), read_frame(recording, 4 + k)
        assert all(np.array_equal(one, other) for one, other in zip(now.images, whole.images, strict=True))
        assert now.cameras == whole.cameras
    assert excerpt(recording, 104).frames == FRAMES - 4 and excerpt(recording, frames=3).first_frame == FIRST
    assert excerpt(recording) is recording and excerpt(recording, FIRST, FRAMES) is recording


def test_what_has_a_row_for_each_frame_is_read_from_the_right_row(recording):
    part = excerpt(excerpt(recording, 102), 104, 5)
    np.testing.assert_array_equal(true_markers(part)[:, 0, 0], [4, 5, 6, 7, 8])
    np.testing.assert_array_equal(cameras_at(part, 1)[1].translation_m, [15, 16, 17])
    # A moving camera's own extrinsics are those of the first frame.
    assert part.views[1].camera == cameras_at(part, 0)[1] and part.views[0].camera == recording.views[0].camera
    np.savez(recording.folder / "truth.npz", markers=np.zeros((8, 15, 3)), names=np.array(MARKERS))
    with pytest.raises(InputError, match="markers: 8 frames; expected 9, as the session has with those before it; add"):
        true_markers(part)


def test_a_first_pose_is_that_of_the_first_frame_only(recording):
    assert excerpt(recording, frames=3).initial == recording.initial
    assert excerpt(recording, 101).initial == {}


def test_the_background_is_learned_from_the_whole_recording(recording):
    still = replace(recording, views=recording.views[:1])
    part = excerpt(still, 105, 2)
    assert has_silhouettes(part) and not has_silhouettes(replace(part, recorded=None))
    assert (part.recorded_session.first_frame, part.recorded_session.frames) == (FIRST, FRAMES)
    assert background_of(part, part.views[0]) is background_of(still, still.views[0])


def test_the_file_keeps_it(recording):
    part = excerpt(recording, 104, 5)
    text = save_session(part).read_text(encoding="utf-8")
    assert "first_frame = 104" in text and "frames = 5" in text and "recorded = [100, 12]" in text
    again = load_session(recording.folder)
    assert again.recorded == (100, 12) and again.skipped == 4 and again == part
    assert "recorded" not in save_session(recording).read_text(encoding="utf-8")


@pytest.mark.parametrize("recorded", ["[105, 12]", "[100, 8]"])
def test_a_file_whose_range_was_not_recorded_is_refused(recording, recorded):
    path = save_session(excerpt(recording, 104, 5))
    path.write_text(path.read_text(encoding="utf-8").replace("[100, 12]", recorded), encoding="utf-8")
    with pytest.raises(FaultyFileError, match=r"recorded: frames 10.*, and the session has 104 to 108; expected frames of the recording; correct"):
        load_session(recording.folder)


WRONG = {
    (99, None): "--first-frame: 99; expected a frame of the recording, 100 to 111; give the number of one of its frames",
    (112, None): "--first-frame: 112; expected a frame of the recording, 100 to 111",
    (110, 3): "--frames: 3; expected a whole number from 1 to 2, the frames from 110 to the recording's last, 111; give a smaller number",
    (None, 13): "--frames: 13; expected a whole number from 1 to 12",
    (104, 0): "--frames: 0; expected a whole number from 1 to 8, .*; give a larger number",
}


@pytest.mark.parametrize("asked", WRONG)
def test_frames_that_were_not_recorded(recording, asked):
    with pytest.raises(InputError, match=WRONG[asked]):
        excerpt(recording, *asked)
