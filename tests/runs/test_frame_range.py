"""The range of frames that a run tracks: what the user reads about the first pose of another frame, and what is stored."""

from dataclasses import replace

import pytest

from bayes_body.runs.settings import frames_from, number_of_first

POINTS = {"a": {"l_knee": (10.0, 20.0, 0.9)}}
POSES = {
    "angles": ({"initial": {"elbow": -0.5}}, True),
    "markers": ({"initial_markers": {"l_knee": (0.0, 0.0, 1.0)}}, True),
    "keypoints": ({"initial_keypoints": POINTS}, True),
    "nothing": ({}, False),
}


@pytest.mark.parametrize("pose", POSES)
def test_a_first_pose_of_another_frame_is_told(textured_session, pose):
    changes, told = POSES[pose]
    session, lines = replace(textured_session, **changes), []
    assert frames_from(session, None, lines.append) is session and frames_from(session, 0, lines.append) is session and not lines
    frames_from(session, 2, lines.append)
    assert lines == (["note: the first pose in session.toml belongs to frame 0, and is not used for frame 2."] if told else [])


def test_keypoints_of_all_frames_replace_those_of_the_first(keypoint_session):
    lines = []
    frames_from(replace(keypoint_session, initial_keypoints=POINTS), 2, lines.append)
    assert not lines


def test_the_session_s_own_first_frame_is_not_stored(textured_session):
    part = frames_from(textured_session, 2, print)
    assert number_of_first(part, textured_session) == 2 and number_of_first(textured_session, textured_session) is None
