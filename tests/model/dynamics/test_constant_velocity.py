"""Pose and velocity as two variables: what is predicted, how it is bounded, and that a moving body keeps moving."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.model.body.build import build_body
from bayes_body.model.definition import FirstTable, load_body
from bayes_body.model.dynamics.constant_velocity import Options, build
from bayes_body.model.first import first_of

ARM = build_body("arm_4", load_body("arm_4"))
# One program of each for all walks.
_conditional = jax.jit(lambda walk, previous: walk.conditional(previous))
_draws = jax.jit(lambda walk, previous, keys: jax.vmap(lambda key: walk.sample(key, previous))(keys))
SD = {"sd_deg": {"*": 2.0}, "velocity_sd_deg": {"*": 20.0}}


def test_the_pose_follows_its_velocity_and_stays_within_its_limits():
    walk = build(Options(**SD), ARM, 30.0)
    before = {"pose": jnp.array([0.1, 0.2, -0.1, -0.5]), "velocity": jnp.array([1.0, -2.0, 0.5, 60.0])}
    conditional = _conditional(walk, before)
    high = np.asarray(ARM.skeleton.high)
    assert np.allclose(conditional["pose"].loc, np.minimum(np.asarray(before["pose"]) + np.asarray(before["velocity"]) / 30, high), atol=1e-6)
    states = _draws(walk, before, jax.random.split(jax.random.key(0), 4000))
    poses, velocities = np.asarray(states["pose"]), np.asarray(states["velocity"])
    assert (poses <= high + 1e-6).all() and poses[:, 3].max() > high[3] - 0.01
    # At 30 fps two frames of 60 fps have passed: sd √2 times as large.
    assert np.allclose(poses[:, :3].std(axis=0), np.radians(2.0) * np.sqrt(2), rtol=0.06)
    assert np.allclose(velocities.std(axis=0), np.radians(20.0) * np.sqrt(2), rtol=0.06)
    # The limit stops the fast movement into it, and no other.
    onward = np.append(np.asarray(before["velocity"])[:3], 30 * (high[3] + 0.5))
    assert np.abs(velocities.mean(axis=0) - onward).max() < 4 * np.radians(20.0) * np.sqrt(2 / 4000)
    assert (np.asarray(conditional["velocity"].base_dist.loc)[:3] == np.asarray(before["velocity"])[:3]).all()


def test_a_first_pose_stands_still_and_the_density_is_that_of_both_variables():
    walk = build(Options(**SD), ARM, 60.0)
    first = walk.begin({"pose": jnp.array([0.1, 0.2, -0.1, -0.5])})
    assert (np.asarray(first["velocity"]) == 0).all()

    @jax.jit
    def program(key, first):
        state = walk.sample(key, first)
        parts = [d.log_prob(state[name]) for name, d in walk.conditional(first).items()]
        return parts, jax.value_and_grad(lambda v: walk.log_density(state, first | {"velocity": v}))(first["velocity"])

    parts, (log_density, gradient) = program(jax.random.key(1), first)
    assert float(log_density) == pytest.approx(float(sum(map(float, parts))), rel=1e-6)
    assert np.isfinite(gradient).all()


@pytest.mark.parametrize("fps", [30.0, pytest.param(120.0, marks=pytest.mark.slow)])
def test_a_velocity_that_fades_has_the_same_distribution_at_every_frame_rate_and_a_spread_holds_the_pose(fps):
    lasting = Options(**SD, velocity_lasts_s={"*": 0.4}, spread_deg={"shoulder_x": 20.0}, rest_deg={"shoulder_x": 5.0})
    walk = build(lasting, replace(ARM, skeleton=replace(ARM.skeleton, low=jnp.full(4, -jnp.inf), high=jnp.full(4, jnp.inf))), fps)
    first = walk.begin({"pose": jnp.zeros(4)})
    # The stationary standard deviation of the velocity: 20 degrees a second per frame of 60 a second, over all frames that it lasts.
    expected = np.radians(20.0) / np.sqrt(1 - np.exp(-2 / (60 * 0.4)))
    assert np.allclose(walk.first(first)["velocity"].base_dist.scale, expected, rtol=1e-5)

    def after(key):
        start = {**first, "velocity": walk.first(first)["velocity"].sample(key)}
        return jax.lax.fori_loop(0, int(3 * fps), lambda k, state: walk.sample(jax.random.fold_in(key, k), state), start)

    found = jax.jit(jax.vmap(after))(jax.random.split(jax.random.key(2), 4000))
    assert np.allclose(np.asarray(found["velocity"])[:, 1:].std(axis=0), expected, rtol=0.06)
    dof = ARM.skeleton.topology.dof_names.index("shoulder_x")
    held = np.degrees(np.asarray(found["pose"])[:, dof])
    assert abs(held.mean() - 5.0) < 4 * held.std() / np.sqrt(4000)
    # The noise of the pose itself adds a little.
    assert 20.0 < held.std() < 1.6 * 20.0 and np.degrees(np.asarray(found["pose"])[:, 1:]).std(axis=0).min() > 40.0


def test_the_first_velocity_of_a_known_pose_is_not_known():
    pose, names = jnp.array([0.1, 0.2, -0.1, -0.5]), {"velocity_lasts_s": {"elbow": 0.4}}
    first = first_of(FirstTable(), ARM, pose, build(Options(**SD, **names), ARM, 60.0))
    states = first.start(jax.random.key(3), 4000)
    expected = np.radians(20.0) / np.sqrt(1 - np.exp(-2 / (60 * 0.4)))
    assert not first.is_point and (np.asarray(states["pose"]) == np.asarray(pose)).all()
    assert np.asarray(states["velocity"])[:, 3].std() == pytest.approx(expected, rel=0.06) and np.abs(states["velocity"][:, :3]).max() < 1e-4
    assert first.make_certain(first.mode).is_point and first_of(FirstTable(), ARM, pose, build(Options(**SD), ARM, 60.0)).is_point


def test_a_spread_that_would_let_movements_grow_is_refused():
    with pytest.raises(InputError, match=r"dynamics\.spread_deg\.shoulder_x: 0\.1 degrees .*; expected a movement that is damped; give a larger"):
        build(Options(**SD, velocity_lasts_s={"*": 0.4}, spread_deg={"shoulder_x": 0.1}), ARM, 60.0)


def test_velocities_need_deviations_too():
    with pytest.raises(InputError, match=r"dynamics\.velocity_sd_deg: no standard deviation for the dof 'shoulder_x'"):
        build(Options(sd_deg={"*": 2.0}), ARM, 60.0)
