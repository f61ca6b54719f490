"""Pose and velocity as two variables: what is predicted, how it is bounded, and that a moving body keeps moving."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.body.build import build_body
from bayes_body.dynamics.constant_velocity import Options, build
from bayes_body.errors import InputError
from bayes_body.model.definition import load_body

ARM = build_body("arm_4", load_body("arm_4"))
SD = {"sd_deg": {"*": 2.0}, "velocity_sd_deg": {"*": 20.0}}


def test_the_pose_follows_its_velocity_and_stays_within_its_limits():
    walk = build(Options(**SD), ARM, 30.0)
    before = {"pose": jnp.array([0.1, 0.2, -0.1, -0.5]), "velocity": jnp.array([1.0, -2.0, 0.5, 60.0])}
    conditional = walk.conditional(before)
    high = np.asarray(ARM.skeleton.high)
    assert np.allclose(conditional["pose"].loc, np.minimum(np.asarray(before["pose"] + before["velocity"] / 30), high), atol=1e-6)
    states = jax.vmap(lambda key: walk.sample(key, before))(jax.random.split(jax.random.key(0), 4000))
    poses, velocities = np.asarray(states["pose"]), np.asarray(states["velocity"])
    assert (poses <= high + 1e-6).all() and poses[:, 3].max() > high[3] - 0.01
    # At 30 fps two frames of 60 fps have passed: sd √2 times as large.
    assert np.allclose(poses[:, :3].std(axis=0), np.radians(2.0) * np.sqrt(2), rtol=0.06)
    assert np.allclose(velocities.std(axis=0), np.radians(20.0) * np.sqrt(2), rtol=0.06)
    assert np.abs(velocities.mean(axis=0) - np.asarray(before["velocity"])).max() < 4 * np.radians(20.0) * np.sqrt(2 / 4000)


def test_a_first_pose_stands_still_and_the_density_is_that_of_both_variables():
    walk = build(Options(**SD), ARM, 60.0)
    first = walk.begin({"pose": jnp.array([0.1, 0.2, -0.1, -0.5])})
    assert (np.asarray(first["velocity"]) == 0).all()
    state = walk.sample(jax.random.key(1), first)
    each = [d.log_prob(state[name]) for name, d in walk.conditional(first).items()]
    assert float(walk.log_density(state, first)) == pytest.approx(float(sum(each)), rel=1e-6)
    assert np.isfinite(jax.grad(lambda v: walk.log_density(state, first | {"velocity": v}))(first["velocity"])).all()


def test_velocities_need_deviations_too():
    with pytest.raises(InputError, match=r"dynamics\.velocity_sd_deg: no standard deviation for the dof 'shoulder_x'"):
        build(Options(sd_deg={"*": 2.0}), ARM, 60.0)
