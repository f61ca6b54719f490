"""Runs that lost the person start anew where it is found; a run that is continued does the same at the same frames."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.kernels.smc.particle_filter import build_kernel
from bayes_body.model.build import FOUND_S
from bayes_body.tracking.program import compiled_ahead
from bayes_body.tracking.restarts import Restarts
from bayes_body.tracking.track import track

KEY = jax.random.key(11)


class Lost:
    """The body of run 1 is off until frame `since`, from which on the person can be found, with its elbow bent."""

    def __init__(self, model, since):
        self.model, self.since, self.asked = model, since, []

    def off(self, result, frame):
        return np.array([False, frame < self.since])

    def found(self, frame, is_first):
        self.asked.append(frame)
        assert is_first == (frame == 3)
        pose = np.asarray(self.model.first_pose).copy()
        pose[self.model.body.dof_names.index("elbow")] = -2.0
        return self.model.beginning_at(jnp.asarray(pose)) if frame >= self.since else None


def test_a_lost_run_starts_anew_and_the_other_goes_on(textured_session, arm, ahead):
    without = track(KEY, textured_session, arm, build_kernel(), particles=40, runs=2, ahead=ahead)
    lost = Lost(arm, since=3)
    draws = track(KEY, textured_session, arm, build_kernel(), particles=40, runs=2, recovery=lost, ahead=ahead)
    assert lost.asked == [3] and draws.frames_restarted == [3] and without.frames_restarted == []
    np.testing.assert_array_equal(draws.frames[3].restarted, [False, True])
    elbow = arm.body.dof_names.index("elbow")
    assert abs(draws.states["pose"][1, 3, :, elbow].mean() + 2.0) < 0.3
    same = [(draws.states["pose"][run, frame] == without.states["pose"][run, frame]).all() for run, frame in ((0, 3), (0, 4), (1, 2), (1, 3))]
    assert same == [True, True, True, False]


def test_the_first_frame_after_found_poses_is_wider(textured_session, arm):
    """A quarter of a second of the random walk, whose frames are a fifteenth of that at 60 frames a second."""
    found = arm.beginning_at(arm.first_pose, jnp.tile(arm.first_pose, (3, 1)))
    with compiled_ahead(textured_session, arm, build_kernel(), 400) as program:
        pass
    frames = {
        name: track(KEY, textured_session, model, build_kernel(), particles=400, frames=2, ahead=program).frames
        for name, model in (("given", arm), ("found", found))
    }
    joint = arm.body.dof_names.index("shoulder_y")
    given, wide = (frames[name][0].states["pose"][0, :, joint].std() for name in ("given", "found"))
    gap = FOUND_S * textured_session.fps
    assert gap > 3 and abs(wide / given / np.sqrt(gap) - 1) < 0.3
    # Later frames have the usual prior: distances from the ancestors.
    steps = {
        name: np.std(each[1].states["pose"][0, :, joint] - each[0].states["pose"][0, each[1].info.ancestors[0], joint])
        for name, each in frames.items()
    }
    assert abs(steps["found"] / steps["given"] - 1) < 0.2


@pytest.mark.parametrize("since", [3, 4])
def test_a_run_that_is_continued_restarts_in_the_same_way(textured_session, arm, since, ahead):
    whole = track(KEY, textured_session, arm, build_kernel(), particles=40, runs=2, recovery=Lost(arm, since), ahead=ahead)
    assert whole.frames_restarted == [since]
    for stop in (3, 4):
        begun = list(whole.frames)[:stop]
        continued = track(KEY, textured_session, arm, build_kernel(), particles=40, runs=2, into=begun, recovery=Lost(arm, since), ahead=ahead)
        assert (continued.states["pose"] == whole.states["pose"]).all() and continued.frames_restarted == whole.frames_restarted


def test_fewer_frames_are_no_loss(textured_session, arm, ahead):
    lost = Lost(arm, since=0)
    lost.off = lambda result, frame: np.array([False, frame in (0, 1, 3)])
    draws = track(KEY, textured_session, arm, build_kernel(), particles=40, runs=2, recovery=lost, ahead=ahead)
    assert draws.frames_restarted == [] and lost.asked == []


def test_frames_that_nothing_explains_are_a_loss(textured_session, arm, ahead):
    lost = Lost(arm, since=0)
    (seen,) = track(KEY, textured_session, arm, build_kernel(), particles=40, runs=2, frames=1, ahead=ahead).frames
    unseen = dataclasses.replace(seen, info=seen.info._replace(lost=np.array([True, True])))
    assert Restarts(lost, 2, [unseen, unseen, unseen]).frames_off.tolist() == [3, 3]
    assert Restarts(lost, 2, [unseen, unseen, seen]).frames_off.tolist() == [0, 0]


def test_the_frame_file_keeps_it(textured_session, arm, tmp_path, ahead):
    from bayes_body.results.storage import FrameFiles

    files = FrameFiles(tmp_path / "frames")
    track(KEY, textured_session, arm, build_kernel(), particles=40, runs=2, into=files, recovery=Lost(arm, since=3), ahead=ahead)
    np.testing.assert_array_equal(FrameFiles(tmp_path / "frames")[3].restarted, [False, True])
