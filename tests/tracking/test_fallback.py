"""A kernel with a fallback: tracked by two programs, and as one program by itself, with the same result.

The kernels here add whole multiples of a power of two, so that no program rounds otherwise than another.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.density.kernel import NO_ANCESTOR, FilterInfo, KernelWithFallback, NamedKernel
from bayes_body.kernels.laplace import laplace_filter
from bayes_body.model.build import build_model
from bayes_body.results.posterior.diagnostics import diagnose
from bayes_body.results.posterior.stream import to_datatree
from bayes_body.tracking.track import track

KEY, COUNT, FEW = jax.random.key(11), 8, 4


class Moving:
    """A kernel that moves particles by a number of steps, and says how often it was traced."""

    def __init__(self, step, attempt):
        self.step, self.attempt, self.traces = step, attempt, 0

    def __call__(self, key, particles, density):
        self.traces += 1
        ess, steps = (jax.random.randint(key, (), 1, 8).astype(jnp.float32) for key in jax.random.split(key))
        info = FilterInfo(
            ancestors=jnp.full(COUNT, NO_ANCESTOR),
            ess=ess,
            survival_rate=ess[None] / COUNT,
            inverse_temperatures=jnp.ones(1),
            log_evidence=density.previous.log_weights[0],
            lost=jnp.zeros((), bool),
            acceptance_rate=jnp.full(1, jnp.nan),
            evaluations=jnp.full((), 5, jnp.int32),
            modes={"attempt": jnp.full((), self.attempt, jnp.int32), **({} if self.attempt else {"steps": steps})},
        )
        return particles._replace(states={"pose": particles.states["pose"] + self.step * steps}), info


def few(info):
    return info.ess < FEW


def with_fallback(fails=few):
    first, fallback = Moving(2.0**-10, 0), Moving(2.0**-7, 2)
    return KernelWithFallback(first, fails, fallback), first, fallback


def equal(one, other):
    for name in ("ess", "evaluations", "lost"):
        np.testing.assert_array_equal(getattr(one.info, name), getattr(other.info, name))
    for name in ("attempt", "steps"):
        np.testing.assert_array_equal(one.info.modes[name], other.info.modes[name])
    np.testing.assert_array_equal(one.states["pose"], other.states["pose"])


# The kernel's name decides whether the devices share the runs.
@pytest.mark.slow
@pytest.mark.parametrize("name", ["laplace", ""])
def test_runs_decide_alone_and_get_what_the_kernel_alone_gives(textured_session, arm, name):
    parts, first, fallback = with_fallback()
    kernel = NamedKernel(name, laplace_filter.Options(), parts)
    draws = track(KEY, textured_session, arm, kernel, COUNT, runs=2)
    attempts = draws.info.modes["attempt"]
    assert (attempts[0] != attempts[1]).any() and set(attempts.ravel().tolist()) == {0, 2}
    assert (draws.info.evaluations == np.where(attempts == 2, 10, 5)).all()
    assert first.traces == fallback.traces == 1

    def alone(key, particles, density):
        return parts(key, particles, density)

    equal(draws, track(KEY, textured_session, arm, alone, COUNT, runs=2))
    store = list(draws.frames)[:3]
    equal(track(KEY, textured_session, arm, kernel, COUNT, runs=2, into=store), draws)


def test_a_fallback_that_no_frame_needs_is_never_traced(textured_session, arm):
    parts, _, fallback = with_fallback(lambda info: info.ess < 0)
    draws = track(KEY, textured_session, arm, parts, COUNT, frames=2)
    assert fallback.traces == 0 and (draws.info.modes["attempt"] == 0).all()


def test_only_the_first_frame_of_a_fallback_waits_for_its_program(textured_session, arm):
    draws = track(jax.random.key(14), textured_session, arm, with_fallback()[0], COUNT)
    assert np.flatnonzero(draws.info.modes["attempt"][0] == 2).tolist() == [1, 3, 4]
    assert np.flatnonzero([frame.seconds_ready > 0 for frame in draws.frames]).tolist() == [0, 1]


@pytest.mark.long
def test_laplace_falls_back_in_tracking_as_it_does_alone(keypoint_session, monkeypatch):
    model = build_model("arm_markers", keypoint_session)
    # No frame is good enough for it.
    monkeypatch.setattr(laplace_filter, "_limits", lambda options: laplace_filter.Limits(options.most_k, 2.0))
    kernel = laplace_filter.build_kernel()
    draws = track(KEY, keypoint_session, model, kernel, 256, runs=2, frames=3)
    diagnosis = diagnose(to_datatree(draws))
    assert (draws.info.modes["attempt"] == 2).all() and diagnosis.redone == (0.0, 1.0)
    # The fallback did what no normal distribution fits; without it, every frame with a large k would count.
    assert diagnosis.doubtful_share(-np.inf) == 0.0
    without = dataclasses.replace(diagnosis, attempts=np.zeros_like(diagnosis.attempts), attempt_k=np.array([[0.8, 0.6, np.nan], [0.9, 0.1, 0.71]]))
    assert without.doubtful_share(0.7) == 0.5

    def in_one_program(key, particles, density):
        return kernel(key, particles, density)

    alone = track(KEY, keypoint_session, model, in_one_program, 256, runs=2, frames=3)
    again = track(KEY, keypoint_session, model, kernel, 256, runs=2, frames=3, into=list(draws.frames)[:1])
    np.testing.assert_array_equal(draws.states["pose"], again.states["pose"])
    means, sds = zip(moments(draws), moments(alone), strict=True)
    # Another program may round otherwise, and then draw others.
    assert (np.abs(means[0] - means[1]) < 0.5 * sds[1]).all() and (np.abs(np.log(sds[0] / sds[1])) < 0.5).all()
    np.testing.assert_allclose(draws.info.log_evidence, alone.info.log_evidence, atol=2.0)


def moments(draws):
    weights, x = np.exp(draws.log_weights), draws.states["pose"]
    mean = np.einsum("rfp,rfpd->rfd", weights, x)
    return mean, np.sqrt(np.einsum("rfp,rfpd->rfd", weights, (x - mean[:, :, None]) ** 2))
