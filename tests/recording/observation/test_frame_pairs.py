"""Recordings that mislead a likelihood of two frames: repeated frames, a camera that moves without a path, a single frame."""

import dataclasses
import shutil

import pytest

from bayes_body.base.errors import InputError
from bayes_body.model.build import build_model
from bayes_body.model.definition import load_definition
from bayes_body.recording.observation.frame_pairs import pair_sentences
from bayes_body.runs.finish import check_pairs


@pytest.fixture
def session(textured_session, tmp_path):
    """Its blobs are at the same place in all frames but one: a camera that stands still."""
    folder = tmp_path / "still"
    shutil.copytree(textured_session.folder, folder)
    return dataclasses.replace(textured_session, folder=folder)


def repeat(session, camera, frame):
    pictures = session.folder / camera
    shutil.copy(pictures / f"image{frame - 1:04d}.png", pictures / f"image{frame:04d}.png")


def test_a_picture_that_drifts_without_a_path_is_told(session):
    told = pair_sentences(session, 5)
    assert len(told) == 2
    assert told[0].startswith("camera 'a': its background moves by 2.0 px per frame, and the session has no path of this camera")
    moving = tuple(dataclasses.replace(view, path="path.npz") for view in session.views)
    assert pair_sentences(dataclasses.replace(session, views=moving), 5) == []


def test_frames_that_repeat_are_named(session):
    for frame in (1, 2, 4):
        repeat(session, "b", frame)
    moving = dataclasses.replace(session, views=tuple(dataclasses.replace(view, path="path.npz") for view in session.views))
    (told,) = pair_sentences(moving, 5)
    assert told.startswith("camera 'b': frames 1-2, 4 repeat the picture of the frame before: image motion sees none there")
    assert pair_sentences(moving, 1) == []


def test_a_still_camera_is_not_told_to_move(session):
    for frame in range(1, 5):
        repeat(session, "a", frame)
        repeat(session, "b", frame)
    told = pair_sentences(session, 5)
    assert len(told) == 2 and all("frames 1-4 repeat" in each for each in told)


def test_a_run_says_where_it_is_silent_and_refuses_one_frame(session):
    shown = []
    model = build_model(load_definition("sidenbladh_2000_arm"), session)
    assert len(check_pairs(session, model, 5, shown.append, False)) == 2
    assert shown[0] == "image_motion: silent in frame 0, which has no frame before it: its posterior is the first pose, spread by the motion prior."
    assert len(shown) == 3
    with pytest.raises(InputError, match="frames: one; expected two or more: image_motion compares a frame with the one before"):
        check_pairs(session, model, 1, shown.append, False)
    assert check_pairs(session, build_model("arm", session), 1, shown.append, False) == [] and len(shown) == 3
