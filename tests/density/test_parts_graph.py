"""The graph of a frame's parts: it has the density of the frame, and its joint draws sum over the ancestors exactly."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from workshop.calibration.limb import draw_prior, limb

from bayes_body.density.factor import Factor, Variable
from bayes_body.density.parts_graph import parts_graph
from bayes_body.kernels.messages.particle_bp import Options, pass_messages
from bayes_body.kernels.messages.schedules import schedule
from bayes_body.model.dynamics.rigid_walk import RigidWalk

PARTS, BEFORE = Variable("parts"), Variable("parts", -1)


def reach(values, data):
    """The hand stays near a plane: a factor that is no plate."""
    del data
    return -50.0 * values[PARTS][2, 0] ** 2


def slow(values, data):
    """Parts move little together: a factor of this frame and the one before."""
    del data
    return -30.0 * jnp.sum((values[PARTS][:, :3] - values[BEFORE][:, :3]).sum(axis=0) ** 2)


WHOLE = {
    "none": (),
    "of the frame": (Factor("reach", "prior", (PARTS,), reach),),
    "of two frames": (Factor("reach", "prior", (PARTS,), reach), Factor("slow", "prior", (PARTS, BEFORE), slow)),
}


@pytest.fixture(scope="module")
def frame():
    """The arm, a true pose of it, and its markers."""
    arm = limb()
    truth = jax.jit(draw_prior)(jax.random.key(1), arm)
    return arm, truth, arm.density({}, arm.before).simulate(jax.random.key(2), {"parts": truth})


@pytest.mark.slow
@pytest.mark.parametrize("whole", WHOLE)
def test_the_graph_has_the_density_of_the_frame(frame, whole):
    arm, truth, data = frame
    density = arm.density(data, arm.before)
    density = replace(density, factors=(*density.factors, *WHOLE[whole]))
    built = parts_graph(density)
    # The last two are 10 cm and 30 cm away, where the ancestors differ in weight.
    values = np.asarray(truth) + np.array([0.0, 0.1, -0.3], np.float32)[:, None, None] * np.eye(7, dtype=np.float32)[0]
    found, expected = jax.jit(jax.vmap(lambda value: (built.log_density(value), density.marginal({"parts": value}))))(values)
    np.testing.assert_allclose(found, expected, rtol=2e-5, atol=2e-3)


@pytest.mark.long
def test_joint_draws_of_several_ancestors_have_equal_weights(frame):
    """Without loops the sum over forest and ancestors is the whole density, though each part's own prior is a mixture over ancestors."""
    arm, _, data = frame
    graph = parts_graph(arm.density(data, arm.before))
    options = Options(samples=200, iterations=3, particles=100)
    found = jax.jit(lambda key, graph: pass_messages(key, graph, options, schedule(graph, "flooding", 3)))(jax.random.key(3), graph)
    assert np.ptp(np.asarray(found.joint.log_weights)) < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("sd_rad", [0.05, 0.5])
def test_pairs_of_steps_have_the_density_of_each(sd_rad):
    keys = jax.random.split(jax.random.key(4), 3)
    middle = jnp.array([1.0, -2.0, 1.5, 0.0, 1.0, 0.0, 0.0])
    around = RigidWalk(jnp.tile(middle, (20, 1)), jnp.full(20, 0.05), jnp.full(20, sd_rad))
    steps = RigidWalk(jnp.asarray(around.sample(keys[0])), jnp.linspace(0.02, 0.06, 20), jnp.linspace(0.5, 1.5, 20) * sd_rad)
    values = jnp.asarray(around.sample(keys[1]))
    # One quaternion and its negative are one rotation.
    values = values.at[::2, 3:].multiply(-1)

    def one(value, *step):
        return RigidWalk(*(each[None] for each in step)).log_prob(value[None])

    expected = jax.jit(jax.vmap(lambda value: jax.vmap(lambda *step: one(value, *step))(steps.loc, steps.sd_m, steps.sd_rad)))(values)
    np.testing.assert_allclose(jax.jit(steps.log_prob_of_pairs)(values), expected, rtol=1e-5, atol=2e-3)
