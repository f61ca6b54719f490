"""A program compiled ahead: taken where it fits, made anew where it does not, given up after an error, and never the cause of one."""

import os
import subprocess
import sys
import threading
from concurrent.futures import Future
from dataclasses import replace

import jax
import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.kernels.batching import assumed_accelerator
from bayes_body.kernels.smc.particle_filter import build_kernel
from bayes_body.model.build import build_model
from bayes_body.tracking.program import Layout, compiled_ahead, layout_of, runs_computed
from bayes_body.tracking.track import track

KEY = jax.random.key(11)


class Counted:
    """A kernel that counts how often it is traced."""

    def __init__(self):
        self.kernel, self.traces = build_kernel(), 0

    def __call__(self, key, particles, density):
        self.traces += 1
        return self.kernel(key, particles, density)


def test_what_was_compiled_ahead_is_what_tracks(textured_session, arm):
    kernel = Counted()
    with compiled_ahead(textured_session, arm, kernel, 40) as ahead:
        pass
    draws = track(KEY, textured_session, arm, kernel, 40, runs=2, ahead=ahead)
    assert kernel.traces == 1
    plain = track(KEY, textured_session, arm, build_kernel(), 40, runs=2)
    np.testing.assert_array_equal(draws.states["pose"], plain.states["pose"])


@pytest.mark.slow
def test_of_another_form_it_is_made_anew(textured_session, arm, ahead):
    kernel = Counted()
    assert track(KEY, textured_session, arm, kernel, 50, ahead=ahead).log_weights.shape == (1, 5, 50)
    assert kernel.traces == 1


@pytest.mark.slow
def test_in_double_precision_too(textured_session):
    with jax.enable_x64(True):
        arm, kernel = build_model("arm", textured_session), Counted()
        with compiled_ahead(textured_session, arm, kernel, 40) as ahead:
            pass
        assert track(KEY, textured_session, arm, kernel, 40, ahead=ahead).states["pose"].dtype == np.float64
    assert kernel.traces == 1


def test_after_an_error_nothing_is_begun(textured_session, arm):
    go, kernel = threading.Event(), Counted()

    def late(observer):
        return lambda frame: observer(frame) if go.wait(60) else None

    slow = replace(arm, observers={name: late(observer) for name, observer in arm.observers.items()})
    with pytest.raises(InputError, match="no first pose"), compiled_ahead(textured_session, slow, kernel, 40) as ahead:
        raise InputError("no first pose")
    go.set()
    assert ahead.result(60) is None
    assert kernel.traces == 0
    # Whoever goes on all the same gets a program.
    track(KEY, textured_session, arm, kernel, 40, frames=1, ahead=ahead)
    assert kernel.traces == 1


def test_its_own_error_is_told_where_it_belongs(textured_session, arm):
    failed = Future()
    failed.set_exception(RuntimeError("in the thread"))
    assert len(track(KEY, textured_session, arm, build_kernel(), 40, frames=2, ahead=failed).frames) == 2


LAWS = """
import jax, jax.numpy as jnp
from bayes_body.model.dynamics.diffusion import TruncatedWalk
from bayes_body.model.dynamics.joint_noise import JointNoise
zero, one = jnp.zeros(2), jnp.ones(2)
for law in (TruncatedWalk(zero, one, -one, one), JointNoise(zero, 0.1 * one, -one, one, jnp.array([True, False]))):
    print(jax.jit(lambda law, x: law.log_prob(x)).lower(law, zero).as_text())
"""


@pytest.mark.slow
def test_a_program_is_the_same_in_every_process():
    """Or none that is compiled would be found again: numpyro keeps what a law is made of in a set, whose order hangs on a process's hashes."""
    texts = []
    for seed in ("1", "2"):
        done = subprocess.run([sys.executable, "-c", LAWS], env=os.environ | {"PYTHONHASHSEED": seed}, capture_output=True, text=True, check=True)
        texts.append(done.stdout)
    assert texts[0] == texts[1] and texts[0].count("func.func public") == 2


def test_a_second_run_of_the_same_form_is_not_traced_again(textured_session, arm):
    kernel = Counted()
    for _ in range(2):
        track(KEY, textured_session, arm, kernel, 40, frames=1)
    assert kernel.traces == 1
    track(KEY, textured_session, arm, kernel, 41, frames=1)
    assert kernel.traces == 2


def test_a_kernel_with_the_same_options_is_the_same_object(arm):
    assert arm.kernel("sir", particles=40) is arm.kernel("sir", particles=40)
    assert arm.kernel("sir", particles=40) is not arm.kernel("sir", particles=41)


@pytest.mark.parametrize(("kind", "options"), [("sir", {}), pytest.param("tempered", {"moves": 1}, marks=pytest.mark.slow)])
def test_runs_at_once_draw_what_they_draw_one_by_one(textured_session, arm, kind, options):
    """In a batch XLA may round otherwise, and a choice that then falls otherwise changes a particle: so most of them are compared."""
    kernel = arm.kernel(kind, particles=40, **options)
    draws = {}
    for order in ("one by one", "at once"):
        with runs_computed(order), compiled_ahead(textured_session, arm, kernel, 40, runs=3) as ahead:
            draws[order] = track(KEY, textured_session, arm, kernel, 40, runs=3, frames=1, ahead=ahead)
        assert layout_of(kernel, 3).is_batch is False
    apart = np.abs(draws["at once"].states["pose"] - draws["one by one"].states["pose"]).max(axis=-1)
    assert apart.shape == (3, 1, 40) and np.median(apart) < 1e-4 and (apart < 1e-4).mean() > 0.9
    assert len({states.tobytes() for states in draws["at once"].states["pose"]}) == 3


def test_an_accelerator_computes_all_runs_at_once(arm):
    kernel = arm.kernel("sir", particles=40)
    with assumed_accelerator(1e12):
        assert layout_of(kernel, 3) == Layout(3, 0, is_batch=True) and not layout_of(kernel, 1).is_batch
        with runs_computed("one by one"):
            assert layout_of(kernel, 3) == Layout(3, 0)


@pytest.mark.slow
def test_more_runs_than_devices_draw_what_fewer_draw(keypoint_session):
    """Devices that share the runs compute one at a time: the third run is the first of a second call."""
    model = build_model("arm_markers", keypoint_session)
    kernel = model.kernel("laplace", particles=40, fallback="none")
    assert len(jax.devices()) == 2 and layout_of(kernel, 3).devices == 2
    three, two = (track(KEY, keypoint_session, model, kernel, 40, runs=runs, frames=2).states["pose"] for runs in (3, 2))
    np.testing.assert_array_equal(three[:2], two)
    assert np.isfinite(three).all() and not (three[2] == three[1]).any()
