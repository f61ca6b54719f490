"""Found poses are drawn again by a likelihood, which is known here."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.density.factor import Factor, Variable
from bayes_body.initial.search.automatic import _other_leg
from bayes_body.initial.search.refine import LEAST_GAIN, refine
from bayes_body.model.build import build_model

SD_RAD, FOUND, POSE = 0.15, 32, Variable("pose")


@pytest.fixture(scope="module")
def model(textured_session):
    return build_model("silhouettes", textured_session)


def density_of(model, log_potential, *arguments):
    likelihood = Factor("known", "likelihood", (POSE,), jax.tree_util.Partial(log_potential, *arguments))
    return replace(model.density({}, model.start(1)), factors=(likelihood,))


def normal(target, values, data):
    del data
    return -0.5 * jnp.sum(((values[POSE] - target) / SD_RAD) ** 2)


def test_of_two_groups_of_poses_the_better_one_is_left_and_comes_nearer(model):
    low, high = np.asarray(model.body.skeleton.low, float), np.asarray(model.body.skeleton.high, float)
    start = np.clip(np.asarray(model.first_pose, float), low + 0.3, high - 0.3)
    knees = [model.body.dof_names.index(name) for name in ("l_knee", "r_knee")]
    start[knees] = -0.4, -1.2
    other, target = start.copy(), start + 0.2
    other[knees] = start[knees[::-1]]
    found = refine(model, (density_of(model, normal, jnp.asarray(target, jnp.float32)),) * 2, np.repeat([other, start], FOUND, axis=0), FOUND, 0)
    assert found.shape == (FOUND, len(start)) and ((found >= low - 1e-6) & (found <= high + 1e-6)).all()
    # Every dof began 0.2 away. The posterior with the power that leaves some effective draws is wider than SD_RAD.
    assert np.abs(found.mean(axis=0) - target).mean() < 0.1 and np.abs(found[:, knees].mean(axis=0) - target[knees]).max() < SD_RAD
    assert len(np.unique(found, axis=0)) > FOUND / 2
    fits = [float(normal(target, {POSE: pose}, None)) for pose in found]
    assert fits[0] == max(fits)


@pytest.mark.parametrize(("gain", "taken"), [(LEAST_GAIN + 2, True), (LEAST_GAIN - 2, False)])
def test_another_arm_is_taken_if_it_gains_enough(model, gain, taken):
    low, high = np.asarray(model.body.skeleton.low, float), np.asarray(model.body.skeleton.high, float)
    start = np.clip(np.asarray(model.first_pose, float), low + 0.3, high - 0.3)
    arm = [k for k, name in enumerate(model.body.dof_names) if name.startswith("l_") and name.split("_")[1] in {"shoulder", "elbow"}]
    out = start.copy()
    # The end of the range that is farther away: no step leads there.
    out[arm] = np.where(high[arm] + low[arm] > 2 * start[arm], high[arm] - 0.3, low[arm] + 0.3)

    def either(hanging, other, values, data):
        return jnp.logaddexp(normal(hanging, values, data), gain + normal(other, values, data))

    targets = [jnp.asarray(pose, jnp.float32) for pose in (start, out)]
    found = refine(model, (density_of(model, either, *targets),) * 2, np.tile(start, (FOUND, 1)), FOUND, 0)
    to_hanging, to_other = (np.abs(found[:, arm] - pose[arm]).mean(axis=1) for pose in (start, out))
    assert (np.mean(to_other < to_hanging) > 0.9) if taken else (to_hanging < to_other).all()


def test_poses_stay_where_none_is_allowed(model):
    start = np.tile(np.asarray(model.first_pose, float), (FOUND, 1))
    nothing = density_of(model, lambda values, data: jnp.where(values[POSE][0] > -1e9, -jnp.inf, 0.0))
    np.testing.assert_array_equal(refine(model, (nothing, nothing), start, 5, 0), start[:5])


def test_legs_change_places_below_the_hip():
    assert [_other_leg(name) for name in ("l_knee", "r_toe", "l_hip", "r_wrist", "pelvis", "head")] == [
        "r_knee",
        "l_toe",
        "l_hip",
        "r_wrist",
        "pelvis",
        "head",
    ]
