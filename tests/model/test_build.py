"""A model is built from a definition and a session: measures, limits, the first pose."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from own_terms import plugins_of_this_test
from scipy.stats import kstest, truncnorm

from bayes_body.base import registry
from bayes_body.base.errors import InputError
from bayes_body.model.build import build_model
from bayes_body.model.definition import FirstTable, load_definition
from bayes_body.recording.session.session import Subject


def _with(session, **changes):
    return dataclasses.replace(session, **changes)


def test_height_scales_the_body(textured_session):
    lengths = [build_model("arm", _with(textured_session, subject=Subject(height_m=h))).body.lengths for h in (1.5, 1.8)]
    assert np.allclose(lengths[1] / lengths[0], 1.2)


def test_measures_of_another_body_are_not_taken_but_its_height_is(textured_session):
    subject = Subject(body="deutscher_31", height_m=1.8, lengths_m={"l_thigh": 0.5}, motion_sd={"root_x": 0.02})
    model = build_model("arm", _with(textured_session, subject=subject))
    assert np.isclose(model.body.lengths[0], 0.186 * 1.8)


def test_the_initial_pose_is_the_sessions_and_the_rest_the_middle(textured_session):
    model = build_model("arm", _with(textured_session, initial={"elbow": -0.7}))
    pose = dict(zip(model.body.dof_names, np.asarray(model.initial["pose"]), strict=True))
    assert np.isclose(pose["elbow"], -0.7)
    assert np.isclose(pose["shoulder_z"], 0.0, atol=1e-6)


@pytest.mark.parametrize(
    ("initial", "said"),
    [
        ({"elbo": -0.5}, "'elbo' is not a dof of the body 'arm_4'; did you mean 'elbow'"),
        ({"elbow": 0.5}, "'elbow': 28.65 degrees; expected a value between -150 and 0 degrees"),
    ],
)
def test_an_initial_pose_that_the_body_cannot_take(textured_session, initial, said):
    with pytest.raises(InputError, match=said.replace("(", r"\(")):
        build_model("arm", _with(textured_session, initial=initial))


def test_start_is_the_initial_state_over_and_over(textured_session):
    model = build_model("arm", textured_session)
    particles = model.start(7)
    assert (particles.states["pose"] == model.initial["pose"]).all()
    assert np.isclose(np.exp(particles.log_weights).sum(), 1)
    compiled = jax.jit(lambda: model.start(7))()
    assert (compiled.states["pose"] == particles.states["pose"]).all()


def test_an_uncertain_first_pose_spreads_the_start_within_the_limits(textured_session):
    definition = load_definition("arm_silhouette")
    model = build_model(dataclasses.replace(definition, first=FirstTable(sd_deg={"elbow": 20.0})), textured_session)
    states = np.asarray(model.start(4000, jax.random.key(1)).states["pose"])
    elbow = model.body.dof_names.index("elbow")
    low, high = (float(side[elbow]) for side in (model.body.skeleton.low, model.body.skeleton.high))
    others = np.delete(states, elbow, axis=1)
    assert (others == np.delete(np.asarray(model.initial["pose"]), elbow)).all()
    centre, sd = float(model.initial["pose"][elbow]), np.radians(20.0)
    exact = truncnorm((low - centre) / sd, (high - centre) / sd, centre, sd)
    assert kstest(states[:, elbow], exact.cdf).pvalue > 1e-3
    with pytest.raises(InputError, match=r"first\.sd_deg\.elbwo: matches no dof .*did you mean 'elbow'"):
        build_model(dataclasses.replace(definition, first=FirstTable(sd_deg={"elbwo": 20.0})), textured_session)


def test_several_first_poses_are_taken_equally_often(textured_session):
    model = build_model("arm", textured_session)
    draws = np.asarray(model.first_pose) + np.array([[0.0] * 4, [0.1] * 4, [-0.1] * 4])
    several = model.beginning_at(model.first_pose, jnp.asarray(draws))
    states = np.asarray(several.start(8, jax.random.key(1)).states["pose"])
    counts = [int(np.isclose(states, pose, atol=1e-6).all(axis=1).sum()) for pose in draws]
    assert sorted(counts) == [2, 3, 3] and not several.first.is_point
    assert any(np.allclose(np.asarray(several.first.sample(jax.random.key(2))["pose"]), pose, atol=1e-6) for pose in draws)
    assert (several.beginning_at(model.first_pose).start(3).states["pose"] == model.initial["pose"]).all()


def test_a_model_of_another_subject_of_the_same_body_compiles_nothing_anew(textured_session):
    traces = []

    @jax.jit
    def value(factor, pose):
        traces.append(1)
        return factor.log_potential.body.lengths.sum() + pose.sum()

    for height in (1.6, 1.9):
        model = build_model("arm", _with(textured_session, subject=Subject(height_m=height)))
        value(model.factors[0], model.initial["pose"])
    assert len(traces) == 1


def test_a_smaller_body_takes_what_it_has_of_a_larger_ones_measures(textured_session):
    subject = Subject(
        body="deutscher_31", height_m=1.8, lengths_m={"l_thigh": 0.46, "head": 0.2}, radii_m={"head": (0.1, 0.1), "l_calf": (0.05, 0.03)}
    )
    model = build_model("poon_fleet_2002_legs", _with(textured_session, subject=subject, initial={"l_knee": -0.3, "l_elbow": -0.2}))
    names = model.body.topology.names
    assert np.isclose(model.body.lengths[names.index("l_thigh")], 0.46)
    assert np.allclose(model.body.radii[names.index("l_calf")], [0.05, 0.03])
    assert np.isclose(model.initial["pose"][model.body.dof_names.index("l_knee")], -0.3)
    with pytest.raises(InputError, match="'l_nee' is not a dof"):
        build_model("poon_fleet_2002_legs", _with(textured_session, initial={"l_nee": -0.3}))


def test_a_variable_is_sampled_or_derived_but_not_both(textured_session):
    with plugins_of_this_test():
        plain = registry.find("dynamics", "diffusion")

        @registry.register("dynamics", "twice", plain.options)
        def build(**arguments):
            walk = plain.build(**arguments)
            return dataclasses.replace(walk, derive=jax.tree_util.Partial(lambda sampled: {"pose": 2 * sampled["pose"]}))

        definition = load_definition("arm_silhouette")
        twice = dataclasses.replace(definition, dynamics=dataclasses.replace(definition.dynamics, kind="twice"))
        with pytest.raises(InputError, match=r"dynamics 'diffusion': the variable 'pose' is sampled, and it is derived too; expected"):
            build_model(twice, textured_session)
