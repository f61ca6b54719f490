"""Tracking: one program for all frames, keys by run and frame, what is said of bad arguments and of broken recordings."""

import dataclasses
import shutil

import jax
import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.base.registry import find, names
from bayes_body.kernels.smc.particle_filter import build_kernel
from bayes_body.model.build import build_model
from bayes_body.model.definition import TermDefinition, load_definition
from bayes_body.model.dynamics import rigid_walk
from bayes_body.tracking.track import track

KEY = jax.random.key(11)


@pytest.fixture(scope="module")
def loose_arm(textured_session):
    """Its upper arm and its forearm have a rigid transform each."""
    definition = load_definition("arm")
    walk = TermDefinition("rigid_walk", rigid_walk.Options())
    return build_model(dataclasses.replace(definition, placement="parts", dynamics=walk), textured_session)


@pytest.mark.parametrize("name", ["sir", *(pytest.param(name, marks=pytest.mark.long) for name in names("kernel") if name != "sir")])
def test_a_new_frame_never_retraces(name, textured_session, arm, loose_arm):
    term, traces = find("kernel", name), []
    kernel = term.build(options=term.options())

    def counted(key, particles, density):
        traces.append(1)
        return kernel(key, particles, density)

    draws = track(KEY, textured_session, loose_arm if name == "particle_bp" else arm, counted, particles=40, runs=2)
    assert draws.log_weights.shape == (2, 5, 40)
    assert len(traces) == 1


def test_runs_and_frames_do_not_depend_on_how_many_there_are(textured_session, arm, ahead):
    whole = track(KEY, textured_session, arm, build_kernel(), particles=40, runs=2, ahead=ahead)
    part = track(KEY, textured_session, arm, build_kernel(), particles=40, runs=1, frames=3, ahead=ahead)
    assert (part.states["pose"][0] == whole.states["pose"][0, :3]).all()
    assert not (whole.states["pose"][0] == whole.states["pose"][1]).all()


def test_progress_is_told_frame_by_frame(textured_session, arm, ahead):
    told = []
    track(KEY, textured_session, arm, build_kernel(), particles=40, on_frame=told.append, ahead=ahead)
    assert [(progress.frame, progress.frames) for progress in told] == [(frame + 1, 5) for frame in range(5)]
    assert all(0 < progress.ess <= 40 and progress.seconds_per_frame > 0 for progress in told)


def test_ancestors_connect_the_frames(textured_session, arm, ahead):
    """A particle is its ancestor moved by one frame's noise: no further than eight standard deviations."""
    draws = track(KEY, textured_session, arm, build_kernel(), particles=40, ahead=ahead)
    sd = np.asarray(arm.transition.conditional(arm.initial)["pose"].scale)
    for frame in range(1, 5):
        before = draws.states["pose"][0, frame - 1][draws.info.ancestors[0, frame]]
        assert (np.abs(draws.states["pose"][0, frame] - before) < 8 * sd).all()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"particles": 0}, "particles: 0; expected a whole number from 1 up"),
        ({"runs": -1}, "runs: -1"),
        ({"frames": 6}, "frames: 6; expected a whole number from 1 to 5"),
    ],
)
def test_sizes_that_make_no_sense(textured_session, arm, arguments, said):
    with pytest.raises(InputError, match=said):
        track(KEY, textured_session, arm, build_kernel(), **arguments)


@pytest.fixture
def damageable(textured_session, tmp_path):
    """The session with images of its own."""
    for name in ("a", "b"):
        shutil.copytree(textured_session.folder / name, tmp_path / name)
    return dataclasses.replace(textured_session, folder=tmp_path)


def test_a_frame_that_cannot_be_used_stops_with_its_name_and_keeps_those_before(damageable, arm, ahead):
    """Another camera's, of another size."""
    kept, told = [], []
    shutil.copyfile(damageable.folder / "a" / "image0003.png", damageable.folder / "b" / "image0003.png")
    with pytest.raises(InputError, match=r"image0003\.png"):
        track(KEY, damageable, arm, build_kernel(), particles=40, on_frame=told.append, into=kept, ahead=ahead)
    assert len(kept) == len(told) == 3


def test_a_frame_that_no_camera_saw_is_lost_and_the_filter_goes_on(damageable, arm, ahead):
    for name in ("a/image0002.png", "b/image0002.png", "b/image0003.png"):
        (damageable.folder / name).unlink()
    told = []
    draws = track(KEY, damageable, arm, build_kernel(), particles=40, runs=2, on_frame=told.append, ahead=ahead)
    assert draws.frames_lost == [2]
    assert [progress.lost for progress in told] == [False, False, True, False, False]
    assert draws.frames_unseen == {"a": [2], "b": [2, 3]}
    assert np.asarray(draws.info.lost)[:, 2].all()
    # Nothing told the particles apart.
    assert np.allclose(draws.log_weights[:, 2], -np.log(40), atol=1e-5)


def test_a_session_without_masks_is_told_what_it_lacks(textured_session, arm):
    views = tuple(dataclasses.replace(view, masks=None) for view in textured_session.views)
    with pytest.raises(InputError, match="have no masks"):
        track(KEY, dataclasses.replace(textured_session, views=views), arm, build_kernel(), particles=10)
