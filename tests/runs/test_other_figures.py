"""Somebody whom nobody detected: what the body of the frame before does not explain is not seen, by a filter, when it goes on, and by a smoother."""

import dataclasses

import cv2
import jax
import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.model.build import build_model
from bayes_body.recording.observation.frames import read_frame
from bayes_body.recording.session.session import Segmentation
from bayes_body.results.metrics.fit import projected_masks
from bayes_body.runs.other_figures import near_body, observations_near_body
from bayes_body.runs.track import track


@pytest.fixture
def sessions(textured_session, tmp_path):
    """Silhouettes of the arm in its first pose, and the same with a figure that touches it in the first view and stands apart in the second."""
    model, filmed = build_model("arm_silhouette", textured_session), []
    arms = projected_masks(model, np.asarray(model.initial["pose"]), textured_session)
    for name in ("alone", "crowd"):
        views = []
        for number, (view, arm) in enumerate(zip(textured_session.views, arms, strict=True)):
            mask = arm.copy()
            if name == "crowd" and number < 2:
                mask |= block(arm, 0 if number == 0 else 60)
            pattern = f"{name}_{view.camera.name}_%d.png"
            for frame in range(textured_session.frames):
                cv2.imwrite(str(tmp_path / (pattern % frame)), mask.astype(np.uint8) * 255)
            images = str(textured_session.folder / view.images)
            views.append(dataclasses.replace(view, masks=str(tmp_path / pattern), images=images))
        filmed.append(dataclasses.replace(textured_session, views=tuple(views), segmentation=Segmentation(figures="near_body")))
    return filmed


def block(arm, away):
    """A figure as tall as the image, on the left of an arm's middle, so many pixels away from it."""
    columns = np.flatnonzero(arm.any(axis=0))
    figure = np.zeros_like(arm)
    figure[:, max(columns.min() - 120 - away, 0) : columns.min() - away + 1] = True
    return figure & ~arm


def covered(session, filtered, index):
    """The regions that the evidence of a frame does not see."""
    model = dataclasses.replace(build_model("arm_silhouette", session), observers={"frame": lambda frame: frame})
    return near_body(session, model, filtered).observe(read_frame(session, index))["frame"].covered


@pytest.mark.slow
def test_the_body_of_the_frame_before_says_whose_a_figure_is(sessions):
    alone, crowd = sessions
    model = build_model("arm_silhouette", crowd)
    draws = track(jax.random.key(0), crowd, model, model.kernel("sir", particles=200), frames=3)
    for index in range(3):
        regions, masks = covered(crowd, draws.frames, index), read_frame(crowd, index).masks
        singles = read_frame(alone, index).masks
        for region, mask, single in zip(regions[:2], masks, singles, strict=False):
            assert (mask & ~single & ~region).sum() < 0.05 * single.sum(), "the figure is hidden"
            assert (single & ~region).sum() > 0.5 * single.sum(), "the arm is not"
        assert list(regions[2:]) == [None] * (len(regions) - 2)
        assert list(covered(alone, draws.frames, index)) == [None] * len(regions), "of one person alone, everything is seen"
    # A run that goes on has the same draws.
    goes_on = track(jax.random.key(0), crowd, model, model.kernel("sir", particles=200), frames=3, into=list(draws.frames[:1]))
    for first, second in zip(draws.frames, goes_on.frames, strict=True):
        assert np.array_equal(first.states["pose"], second.states["pose"])


def test_who_does_not_ask_for_it_sees_all(sessions):
    session = dataclasses.replace(sessions[1], segmentation=Segmentation())
    model = build_model("arm_silhouette", session)
    assert near_body(session, model, []) is model and observations_near_body(session, model, model.kernel(), range(2), []) is None
    with pytest.raises(InputError, match="frames: 1000"):
        track(jax.random.key(0), sessions[1], model, model.kernel("sir", particles=20), frames=1000)
