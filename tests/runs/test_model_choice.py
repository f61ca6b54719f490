"""Which model tracks a session if the user names none."""

import dataclasses

import pytest

from bayes_body.base.errors import InputError
from bayes_body.model.definition import load_definition
from bayes_body.runs.settings import choose_model


def _views(session, **changes):
    return dataclasses.replace(session, views=tuple(dataclasses.replace(view, **changes) for view in session.views))


def test_keypoints_come_first(keypoint_session):
    choice = choose_model(keypoint_session)
    assert choice.model == "keypoints"
    assert choice.sentence == "model      keypoints, because 2 of 2 cameras have keypoints; --model names another."


def test_one_camera_with_keypoints_is_enough(keypoint_session):
    first, second = keypoint_session.views
    session = dataclasses.replace(keypoint_session, views=(first, dataclasses.replace(second, keypoints=None)))
    choice = choose_model(session)
    assert choice.reason == "1 of 2 cameras has keypoints"
    assert choice.sentence.endswith("keypoints; in one view depth is uncertain: expect wide intervals; --model names another.")


@pytest.mark.parametrize(
    ("changes", "model", "limits"),
    [
        ({}, "walker_from_the_side", "it tracks the legs only, of a person who walks past the camera, and in one view depth is uncertain"),
        ({"keypoints": "a.npz"}, "keypoints", "in one view depth is uncertain: expect wide intervals"),
        ({"path": "path.npz"}, "silhouettes", "in one view depth is uncertain: expect wide intervals"),
    ],
    ids=["still", "keypoints", "moving"],
)
def test_one_camera(textured_session, changes, model, limits):
    """As README's table recommends; the sentence says what the model cannot do."""
    session = dataclasses.replace(_views(textured_session, **changes), views=_views(textured_session, **changes).views[:1])
    choice = choose_model(session)
    assert choice.model == model and f"; {limits}" in choice.sentence
    if model == "walker_from_the_side":
        assert choice.sentence.startswith(
            "model      walker_from_the_side, because the session has one still camera, with silhouettes (masks) and no keypoints; "
        )


@pytest.mark.parametrize(
    ("changes", "frames", "source"),
    [
        ({}, 5, "masks"),
        ({"masks": None, "background": "empty.png"}, 5, "from an image of the empty scene"),
        ({"masks": None}, 10, "from a background that is learned from the frames"),
    ],
    ids=["masks", "empty scene", "learned"],
)
def test_else_silhouettes(textured_session, changes, frames, source):
    session = dataclasses.replace(_views(textured_session, **changes), frames=frames)
    choice = choose_model(session)
    assert choice.model == "silhouettes"
    assert choice.sentence == f"model      silhouettes, because the session has silhouettes ({source}) and no keypoints; --model names another."


@pytest.mark.parametrize(
    ("changes", "frames"), [({"masks": None}, 5), ({"masks": None, "path": "path.npz"}, 100)], ids=["too few frames", "a moving camera"]
)
def test_a_session_with_neither_is_refused_with_the_remedy(textured_session, changes, frames):
    session = dataclasses.replace(_views(textured_session, **changes), frames=frames)
    with pytest.raises(InputError, match=r"neither keypoints nor silhouettes; expected .*; import .* --keypoints or --masks.* --model"):
        choose_model(session)


def test_no_mode_seeker_is_chosen(textured_session, keypoint_session):
    for session in (textured_session, keypoint_session):
        assert load_definition(choose_model(session).model).kernel.kind != "annealed"
